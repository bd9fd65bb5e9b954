"""Vision transformers (Dosovitskiy et al., ICLR 2021) as in DINOv2 (Oquab et al., TMLR 2024)."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.gem import GeneralizedMean
from mfvpr.networks.imagenet import Images, of_unit_length, preprocess
from mfvpr.utils.errors import InputError

Pooling = Literal["cls", "gem"]

PATCH = 14  # px a side
_TRAINED = 37  # patches per side of the training images (518 px), which the positions fit
_OFFSET = 0.1  # added to the number of patches for the positions' scale, as published
_EPSILON = 1e-6  # of the normalization
_EXPANSION = 4  # of the hidden values
_CUBIC = -0.75  # torch's parameter of bicubic interpolation


class Tokens(NamedTuple):
    """Output of a transformer."""

    class_token: Float[Array, "batch width"]
    maps: Float[Array, "batch rows columns width"]  # tokens of the patches


class BlockOutput(NamedTuple):
    """Tokens, queries, keys and values of one block's patches, and the attention to the patches.

    Heads are joined. Queries are not scaled.
    """

    token: Float[Array, "batch rows columns width"]  # after the block, normalized as the last tokens
    query: Float[Array, "batch rows columns width"]
    key: Float[Array, "batch rows columns width"]
    value: Float[Array, "batch rows columns width"]
    attention: Float[Array, "batch rows columns"]  # of the class token, mean over the heads


class Patches(nnx.Module):
    """Linear map of each patch: `kernel` `[14, 14, 3, D]`, `bias` `[D]`."""

    def __init__(self, width: int, *, precision: str, rngs: nnx.Rngs) -> None:
        initial = nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(initial(rngs.params(), (PATCH, PATCH, 3, width), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(width, jnp.float32))
        self.precision = precision

    def __call__(self, images: Images) -> Float[Array, "batch (height//14)*(width//14) dimensions"]:
        batch, rows, columns = len(images), images.shape[1] // PATCH, images.shape[2] // PATCH
        pixels = images.reshape(batch, rows, PATCH, columns, PATCH, 3).swapaxes(2, 3)
        kernel = self.kernel[...].reshape(-1, self.kernel.shape[-1])
        products = jnp.matmul(pixels.reshape(batch, rows * columns, -1), kernel, precision=self.precision)
        return products + self.bias[...][None, None]


class Attention(nnx.Module):
    """Multi-head self-attention of tokens."""

    def __init__(self, width: int, heads: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.qkv = nnx.Linear(width, 3 * width, precision=precision, rngs=rngs)
        self.output = nnx.Linear(width, width, precision=precision, rngs=rngs)
        self.heads = heads
        self.precision = precision

    def split(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "3 batch heads tokens width//heads"]:
        """Queries, keys and values of each head."""
        batch, tokens, _ = x.shape
        return jnp.moveaxis(self.qkv(x).reshape(batch, tokens, 3, self.heads, -1), (2, 3), (0, 2))

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        queries, keys, values = self.split(x)
        queries = queries * queries.shape[-1] ** -0.5
        logits = jnp.matmul(queries, keys.swapaxes(2, 3), precision=self.precision)
        weights = jnp.exp(logits - jnp.max(logits, axis=-1, keepdims=True))
        context = jnp.matmul(weights, values, precision=self.precision) / jnp.sum(weights, axis=-1, keepdims=True)
        return self.output(jnp.moveaxis(context, 1, 2).reshape(x.shape))


class Perceptron(nnx.Module):
    """Two linear layers with GELU between them."""

    def __init__(self, width: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.hidden = nnx.Linear(width, _EXPANSION * width, precision=precision, rngs=rngs)
        self.output = nnx.Linear(_EXPANSION * width, width, precision=precision, rngs=rngs)

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        return self.output(jax.nn.gelu(self.hidden(x), approximate=False))


class Block(nnx.Module):
    """x + scale1 attention(norm1(x)), then x + scale2 perceptron(norm2(x))."""

    def __init__(self, width: int, heads: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.norm1, self.norm2 = (_norm(width, rngs) for _ in range(2))
        self.attention = Attention(width, heads, precision=precision, rngs=rngs)
        self.perceptron = Perceptron(width, precision=precision, rngs=rngs)
        self.scale1, self.scale2 = (nnx.Param(jnp.ones(width, jnp.float32)) for _ in range(2))

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        x = x + self.scale1[...][None, None] * self.attention(self.norm1(x))
        return x + self.scale2[...][None, None] * self.perceptron(self.norm2(x))


class VisionTransformer(nnx.Module):
    """Transformer with a class token, optional registers, and tokens of patches of 14 x 14 px.

    DINOv2's small, base and large networks have `width` (numbers of a token) 384, 768, 1024, `depth` (blocks) 12, 12,
    24 and `heads` 6, 12, 16. `registers` are additional tokens, which are not returned; 4 or none are published.
    """

    def __init__(
        self,
        width: int,
        depth: int,
        heads: int,
        *,
        registers: int = 0,
        block: type[Block] = Block,
        precision: str = "highest",
        rngs: nnx.Rngs,
    ) -> None:
        self.patches = Patches(width, precision=precision, rngs=rngs)
        self.first = nnx.Param(jnp.zeros(width, jnp.float32))  # the class token
        self.positions = nnx.Param(jnp.zeros((1 + _TRAINED**2, width), jnp.float32))
        if registers:
            self.registers = nnx.Param(jnp.zeros((registers, width), jnp.float32))
        self.has_registers = registers > 0
        blocks = (block(width, heads, precision=precision, rngs=rngs) for _ in range(depth))
        self.blocks = nnx.List(list(blocks))
        self.norm = _norm(width, rngs)
        self.width = width
        self.precision = precision

    preprocess = staticmethod(preprocess)

    def __call__(self, images: Images) -> Tokens:
        """Normalized tokens of preprocessed images."""
        x = self._embed(images)
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        return Tokens(x[:, 0], self._maps(x, images))

    def with_block(self, images: Images, index: int) -> tuple[Tokens, BlockOutput]:
        """Normalized tokens of preprocessed images, and the output of the block with this index."""
        states = [self._embed(images)]
        for block in self.blocks:
            states.append(block(states[-1]))
        x = self.norm(states[-1])
        place, block = index % len(self.blocks), self.blocks[index]
        parts = block.attention.split(block.norm1(states[place]))
        joined = jnp.moveaxis(parts, 2, 3).reshape(3, *states[place].shape)
        attention = jnp.mean(_class_attention(parts[0], parts[1], self.precision), axis=1)
        last, token, query, key, value, weights = (
            self._maps(values, images) for values in (x, self.norm(states[place + 1]), *joined, attention)
        )
        return Tokens(x[:, 0], last), BlockOutput(token, query, key, value, weights)

    def _embed(self, images: Images) -> Float[Array, "batch tokens dimensions"]:
        """Class token, registers and patches with their positions, the input of the first block."""
        maps = self.patches(images) + self._positions(images.shape[1] // PATCH, images.shape[2] // PATCH)[None]
        first = (self.first[...] + self.positions[...][0])[None]
        extra = jnp.concatenate([first, self.registers[...]]) if self.has_registers else first
        return jnp.concatenate([jnp.broadcast_to(extra, (len(images), *extra.shape)), maps], axis=1)

    def _maps(
        self, x: Float[Array, "batch tokens *dimensions"], images: Images
    ) -> Float[Array, "batch rows columns *dimensions"]:
        """Values of the patches' tokens, which are the last."""
        rows, columns = images.shape[1] // PATCH, images.shape[2] // PATCH
        return x[:, -rows * columns :].reshape(len(x), rows, columns, *x.shape[2:])

    def _positions(self, rows: int, columns: int) -> Float[Array, "{rows}*{columns} width"]:
        """Position encodings of the patches: the learned ones, resized without antialiasing."""
        learned = self.positions[...][1:]
        if rows == columns == _TRAINED:
            return learned
        grid = learned.reshape(_TRAINED, _TRAINED, -1)
        for axis, count in enumerate((rows, columns)):
            resized = jnp.tensordot(_bicubic(_TRAINED, count), grid, axes=(1, axis), precision=self.precision)
            grid = jnp.moveaxis(resized, 0, axis)
        return grid.reshape(rows * columns, -1)


def require_patches(size: tuple[int, int]) -> None:
    """Raise an InputError unless width and height (px) are multiples of a patch's side."""
    if any(side < PATCH or side % PATCH for side in size):
        raise InputError(f"image_size={list(size)}: expected multiples of {PATCH}, the side of a patch in px")


class TokenDescriptor(nnx.Module):
    """Global descriptor of a transformer's tokens.

    Args:
        network: the transformer with its weights.
        pooling: "cls" uses the class token, "gem" the generalized mean of the patches' tokens of unit length.
        power: power of the generalized mean.
    """

    def __init__(self, network: VisionTransformer, pooling: Pooling = "cls", power: float = 3.0) -> None:
        self.network = network
        self.pool = GeneralizedMean(power)
        self.pooling = pooling
        self.dimension = network.width
        self.has_components = False

    preprocess = staticmethod(VisionTransformer.preprocess)
    require = staticmethod(require_patches)

    def __call__(self, images: Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length of preprocessed images."""
        class_token, maps = self.network(images)
        return of_unit_length(class_token if self.pooling == "cls" else self.pool(of_unit_length(maps)))


def _class_attention(
    queries: Float[Array, "batch heads tokens size"], keys: Float[Array, "batch heads tokens size"], precision: str
) -> Float[Array, "batch heads tokens"]:
    """Attention of the class token, the first, to all tokens: a softmax."""
    scaled = queries[:, :, :1] * queries.shape[-1] ** -0.5
    return jax.nn.softmax(jnp.matmul(scaled, keys.swapaxes(2, 3), precision=precision)[:, :, 0], axis=-1)


def _norm(width: int, rngs: nnx.Rngs) -> nnx.LayerNorm:
    return nnx.LayerNorm(width, epsilon=_EPSILON, use_fast_variance=False, rngs=rngs)


def _bicubic(size: int, count: int) -> Float[Array, "{count} {size}"]:
    """Matrix of the interpolation at `count` places, `size / (count + 0.1)` apart; edges repeat."""
    places = (np.arange(count) + 0.5) * size / (count + _OFFSET) - 0.5
    before, matrix = np.floor(places).astype(int), np.zeros((count, size))
    for step in (-1, 0, 1, 2):
        distance = np.abs(places - (before + step))
        near = ((_CUBIC + 2) * distance - (_CUBIC + 3)) * distance**2 + 1
        far = ((distance - 5) * distance + 8) * distance * _CUBIC - 4 * _CUBIC
        pixel = np.clip(before + step, 0, size - 1)
        np.add.at(matrix, (np.arange(count), pixel), np.where(distance <= 1, near, far))
    return jnp.asarray(matrix, jnp.float32)
