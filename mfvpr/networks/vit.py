"""Vision transformers (Dosovitskiy et al., ICLR 2021) as in DINOv2 (Oquab et al., TMLR 2024) and SelaVPR."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks import layers
from mfvpr.utils.errors import InputError

Pooling = Literal["cls", "gem"]

PATCH = 14  # px a side
LOCAL = 128  # channels of SelaVPR's local map
_TRAINED = 37  # patches per side of the training images (518 px), which the positions fit
_OFFSET = 0.1  # added to the number of patches for the positions' scale, as published
_EPSILON = 1e-6  # of the normalization
_CUBIC = -0.75  # torch's parameter of bicubic interpolation


class Tokens(NamedTuple):
    class_token: Float[Array, "batch width"]
    maps: Float[Array, "batch rows columns width"]  # tokens of the patches


class BlockOutput(NamedTuple):
    """Tokens, queries, keys and values of one block's patches, and the attention to the patches.

    Heads are joined. Queries are not scaled.
    """

    token: Float[Array, "batch rows columns width"]  # after the block, normalized as the last tokens
    query: Array
    key: Array
    value: Array
    attention: Float[Array, "batch rows columns"]  # of the class token, mean over the heads


class Attention(nnx.Module):
    """Multi-head self-attention of tokens."""

    def __init__(self, width: int, heads: int, *, rngs: nnx.Rngs) -> None:
        self.qkv = layers.Linear(width, 3 * width, rngs=rngs)
        self.output = layers.Linear(width, width, rngs=rngs)
        self.heads = heads

    def split(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "3 batch heads tokens width//heads"]:
        """Queries, keys and values of each head."""
        batch, tokens, _ = x.shape
        return jnp.moveaxis(self.qkv(x).reshape(batch, tokens, 3, self.heads, -1), (2, 3), (0, 2))

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        queries, keys, values = self.split(x)
        queries = queries * queries.shape[-1] ** -0.5
        logits = layers.matmul(queries, keys.swapaxes(2, 3))
        weights = jnp.exp(logits - jnp.max(logits, axis=-1, keepdims=True))
        context = layers.matmul(weights, values) / jnp.sum(weights, axis=-1, keepdims=True)
        return self.output(jnp.moveaxis(context, 1, 2).reshape(x.shape))


class Perceptron(nnx.Module):
    """Two linear layers with GELU or ReLU between them."""

    def __init__(self, width: int, hidden: int, *, relu: bool = False, rngs: nnx.Rngs) -> None:
        self.hidden, self.output = layers.Linear(width, hidden, rngs=rngs), layers.Linear(hidden, width, rngs=rngs)
        self.relu = relu

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        hidden = self.hidden(x)
        return self.output(nnx.relu(hidden) if self.relu else jax.nn.gelu(hidden, approximate=False))


class Block(nnx.Module):
    """x + scale1 attention(norm1(x)), then x + scale2 perceptron(norm2(x))."""

    def __init__(self, width: int, heads: int, *, rngs: nnx.Rngs) -> None:
        self.norm1, self.norm2 = (layers.LayerNorm(width, epsilon=_EPSILON, rngs=rngs) for _ in range(2))
        self.attention = Attention(width, heads, rngs=rngs)
        self.perceptron = Perceptron(width, 4 * width, rngs=rngs)
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
        self, width: int, depth: int, heads: int, *, registers: int = 0, block: type[Block] = Block, rngs: nnx.Rngs
    ) -> None:
        patch = {"kernel_size": (PATCH, PATCH), "strides": PATCH, "padding": "VALID"}
        self.patches = nnx.Conv(3, width, **patch, precision=layers.PRECISION, rngs=rngs)
        self.first = nnx.Param(jnp.zeros(width, jnp.float32))  # the class token
        self.positions = nnx.Param(jnp.zeros((1 + _TRAINED**2, width), jnp.float32))
        if registers:
            self.registers = nnx.Param(jnp.zeros((registers, width), jnp.float32))
        self.has_registers = registers > 0
        self.blocks = nnx.List([block(width, heads, rngs=rngs) for _ in range(depth)])
        self.norm = layers.LayerNorm(width, epsilon=_EPSILON, rngs=rngs)
        self.dimension = width

    preprocess = staticmethod(layers.preprocess)

    def __call__(self, images: layers.Images) -> Tokens:
        """Normalized tokens of preprocessed images."""
        return self._tokens(self._states(images)[-1], images)

    def with_block(self, images: layers.Images, index: int) -> tuple[Tokens, BlockOutput]:
        """Normalized tokens of preprocessed images, and the output of the block with this index."""
        states = self._states(images)
        place, block = index % len(self.blocks), self.blocks[index]
        parts = block.attention.split(block.norm1(states[place]))
        joined = jnp.moveaxis(parts, 2, 3).reshape(3, *states[place].shape)
        of_class = parts[0, :, :, :1] * parts.shape[-1] ** -0.5  # query of the class token, the first
        attention = jax.nn.softmax(layers.matmul(of_class, parts[1].swapaxes(2, 3))[:, :, 0], axis=-1)
        values = (self.norm(states[place + 1]), *joined, jnp.mean(attention, axis=1))
        return self._tokens(states[-1], images), BlockOutput(*(_maps(each, images) for each in values))

    def _states(self, images: layers.Images) -> list[Float[Array, "batch tokens dimensions"]]:
        """Inputs of the blocks, and the output of the last; the first has class token, registers and patches."""
        positions = _resize_positions(self.positions[...][1:], images.shape[1] // PATCH, images.shape[2] // PATCH)
        first = (self.first[...] + self.positions[...][0])[None]
        extra = jnp.concatenate([first, self.registers[...]]) if self.has_registers else first
        extra = jnp.broadcast_to(extra, (len(images), *extra.shape))
        patches = self.patches(images).reshape(len(images), -1, self.dimension)
        states = [jnp.concatenate([extra, patches + positions[None]], axis=1)]
        for block in self.blocks:
            states.append(block(states[-1]))
        return states

    def _tokens(self, state: Float[Array, "batch tokens dimensions"], images: layers.Images) -> Tokens:
        normalized = self.norm(state)
        return Tokens(normalized[:, 0], _maps(normalized, images))


def _maps(x: Float[Array, "batch tokens *dimensions"], images: layers.Images) -> Array:
    """Values of the patches' tokens, which are the last."""
    rows, columns = images.shape[1] // PATCH, images.shape[2] // PATCH
    return x[:, -rows * columns :].reshape(len(x), rows, columns, *x.shape[2:])


def _resize_positions(learned: Array, rows: int, columns: int) -> Float[Array, "{rows}*{columns} width"]:
    """Position encodings of the patches: the learned ones, resized by bicubic interpolation; edges repeat.

    Places are `_TRAINED / (count + 0.1)` apart, and there is no antialiasing, as published.
    """
    if rows == columns == _TRAINED:
        return learned
    grid = learned.reshape(_TRAINED, _TRAINED, -1)
    for axis, count in enumerate((rows, columns)):
        places = (np.arange(count) + 0.5) * _TRAINED / (count + _OFFSET) - 0.5
        before, matrix = np.floor(places).astype(int), np.zeros((count, _TRAINED))
        for step in (-1, 0, 1, 2):
            distance = np.abs(places - (before + step))
            near = ((_CUBIC + 2) * distance - (_CUBIC + 3)) * distance**2 + 1
            far = ((distance - 5) * distance + 8) * distance * _CUBIC - 4 * _CUBIC
            pixel = np.clip(before + step, 0, _TRAINED - 1)
            np.add.at(matrix, (np.arange(count), pixel), np.where(distance <= 1, near, far))
        resized = jnp.tensordot(jnp.asarray(matrix, jnp.float32), grid, axes=(1, axis), precision=layers.PRECISION)
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
        self.pool = layers.GeneralizedMean(power)
        self.pooling = pooling
        self.dimension = network.dimension
        self.has_components = False

    preprocess = staticmethod(layers.preprocess)
    require = staticmethod(require_patches)

    def __call__(self, images: layers.Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length of preprocessed images."""
        class_token, maps = self.network(images)
        return layers.of_unit_length(class_token if self.pooling == "cls" else self.pool(layers.of_unit_length(maps)))


class AdaptedBlock(Block):
    """A block with one adapter behind its attention, and one beside its perceptron, which counts a fifth.

    An adapter is a perceptron with half as many hidden values and ReLU.
    """

    def __init__(self, width: int, heads: int, *, rngs: nnx.Rngs) -> None:
        super().__init__(width, heads, rngs=rngs)
        self.serial, self.parallel = (Perceptron(width, width // 2, relu=True, rngs=rngs) for _ in range(2))

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        attended = self.attention(self.norm1(x))
        x = x + self.scale1[...][None, None] * (attended + self.serial(attended))
        normalized = self.norm2(x)
        return x + self.scale2[...][None, None] * (self.perceptron(normalized) + 0.2 * self.parallel(normalized))


class Upsampling(nnx.Module):
    """Transposed 3 x 3 convolution, stride 2, padding 1.

    `kernel` `[3, 3, C, D]` adds position (i, j) of the input to (2 i + row - 1, 2 j + column - 1); `bias` is `[D]`.
    """

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(nnx.initializers.he_normal()(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))

    def __call__(
        self, x: Float[Array, "batch rows columns inputs"]
    ) -> Float[Array, "batch 2*rows-1 2*columns-1 outputs"]:
        """Multiply by the whole kernel at once, then add neighbors, which avoids products with zeros."""
        parts = jnp.tensordot(x, self.kernel[...], axes=(3, 2), precision=layers.PRECISION)  # [B, h, w, 3, 3, D]
        for axis in (1, 2):  # n positions add three outputs each, which become 2 n - 1
            before, here, after = (jnp.take(parts, place, axis=3) for place in range(3))
            between = after + jnp.roll(before, -1, axis)  # the last is dropped
            pairs = jnp.stack([here, between], axis=axis + 1)
            merged = pairs.reshape(*pairs.shape[:axis], -1, *pairs.shape[axis + 2 :])
            parts = jax.lax.slice_in_dim(merged, 0, merged.shape[axis] - 1, axis=axis)
        return parts + self.bias[...][None, None, None]


class SelaVpr(nnx.Module):
    """SelaVPR (Lu et al., ICLR 2024): DINOv2 with adapters, its generalized mean, and a dense map of local features.

    The map's grid is four times as fine as the patches. The arguments are those of `VisionTransformer`; ViT-L is
    published, with 4 registers and without.
    """

    def __init__(
        self, width: int = 1024, depth: int = 24, heads: int = 16, *, registers: int = 0, rngs: nnx.Rngs
    ) -> None:
        self.backbone = VisionTransformer(width, depth, heads, registers=registers, block=AdaptedBlock, rngs=rngs)
        self.pool = layers.GeneralizedMean()
        self.upsampling1, self.upsampling2 = Upsampling(width, 256, rngs=rngs), Upsampling(256, LOCAL, rngs=rngs)
        self.dimension = width

    preprocess = staticmethod(layers.preprocess)

    def __call__(
        self, images: layers.Images
    ) -> tuple[Float[Array, "batch dimensions"], Float[Array, "batch 4*(height//14)-3 4*(width//14)-3 128"]]:
        """Global descriptors and local descriptors of unit length of preprocessed images."""
        maps = self.backbone(images).maps
        local = self.upsampling2(nnx.relu(self.upsampling1(maps)))
        return layers.of_unit_length(self.pool(layers.of_unit_length(maps))), layers.of_unit_length(local)
