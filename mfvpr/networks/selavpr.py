"""SelaVPR (Lu et al., ICLR 2024): DINOv2 with adapters, its generalized mean, and a dense map of local features."""

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.gem import GeneralizedMean
from mfvpr.networks.imagenet import Images, of_unit_length
from mfvpr.networks.vit import Block, VisionTransformer

_PARALLEL = 0.2  # weight of the parallel adapter
_BOTTLENECK = 2  # width of a token over hidden values of an adapter
_HIDDEN, LOCAL = 256, 128  # channels of the two upsampled maps


class Adapter(nnx.Module):
    """Two linear layers with half as many hidden values, ReLU between."""

    def __init__(self, width: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.down = nnx.Linear(width, width // _BOTTLENECK, precision=precision, rngs=rngs)
        self.up = nnx.Linear(width // _BOTTLENECK, width, precision=precision, rngs=rngs)

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        return self.up(nnx.relu(self.down(x)))


class AdaptedBlock(Block):
    """A block with one adapter behind its attention, and one beside its perceptron."""

    def __init__(self, width: int, heads: int, *, precision: str, rngs: nnx.Rngs) -> None:
        super().__init__(width, heads, precision=precision, rngs=rngs)
        self.serial, self.parallel = (Adapter(width, precision=precision, rngs=rngs) for _ in range(2))

    def __call__(self, x: Float[Array, "batch tokens width"]) -> Float[Array, "batch tokens width"]:
        scale1, attended = self.scale1[...][None, None], self.attention(self.norm1(x))
        x = x + scale1 * (attended + self.serial(attended))
        scale2, normalized = self.scale2[...][None, None], self.norm2(x)
        return x + scale2 * (self.perceptron(normalized) + _PARALLEL * self.parallel(normalized))


class Upsampling(nnx.Module):
    """Transposed 3 x 3 convolution, stride 2, padding 1.

    `kernel` `[3, 3, C, D]` adds position (i, j) of the input to (2 i + row - 1, 2 j + column - 1); `bias` is `[D]`.
    """

    def __init__(self, inputs: int, outputs: int, *, precision: str, rngs: nnx.Rngs) -> None:
        initial = nnx.initializers.he_normal()
        self.kernel = nnx.Param(initial(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))
        self.precision = precision

    def __call__(
        self, x: Float[Array, "batch rows columns inputs"]
    ) -> Float[Array, "batch 2*rows-1 2*columns-1 outputs"]:
        """Multiply by the whole kernel at once, then add neighbors, which avoids products with zeros."""
        parts = jnp.tensordot(x, self.kernel[...], axes=(3, 2), precision=self.precision)  # [B, h, w, 3, 3, D]
        rows = _interleave(parts, axis=1, kernel_axis=3)
        return _interleave(rows, axis=2, kernel_axis=3) + self.bias[...][None, None, None]


def _interleave(parts: Array, axis: int, kernel_axis: int) -> Array:
    """Sum the parts of n positions along an axis, each for three outputs, to 2 n - 1 outputs."""
    before, here, after = (jnp.take(parts, place, axis=kernel_axis) for place in range(3))
    last = here.shape[axis] - 1
    between = _part(after, 0, last, axis) + _part(before, 1, last + 1, axis)
    pairs = jnp.stack([_part(here, 0, last, axis), between], axis=axis + 1)
    merged = pairs.reshape(*pairs.shape[:axis], 2 * last, *pairs.shape[axis + 2 :])
    return jnp.concatenate([merged, _part(here, last, last + 1, axis)], axis=axis)


def _part(values: Array, start: int, stop: int, axis: int) -> Array:
    return jnp.take(values, jnp.arange(start, stop), axis=axis)


class SelaVpr(nnx.Module):
    """SelaVPR's global descriptor, and local descriptors on a grid four times as fine as the patches.

    The arguments are those of `VisionTransformer`; ViT-L is published, with 4 registers and without.
    """

    def __init__(
        self,
        width: int = 1024,
        depth: int = 24,
        heads: int = 16,
        *,
        registers: int = 0,
        precision: str = "highest",
        rngs: nnx.Rngs,
    ) -> None:
        self.backbone = VisionTransformer(
            width, depth, heads, registers=registers, block=AdaptedBlock, precision=precision, rngs=rngs
        )
        self.pool = GeneralizedMean()
        self.upsampling1 = Upsampling(width, _HIDDEN, precision=precision, rngs=rngs)
        self.upsampling2 = Upsampling(_HIDDEN, LOCAL, precision=precision, rngs=rngs)
        self.dimension = width

    preprocess = staticmethod(VisionTransformer.preprocess)

    def __call__(
        self, images: Images
    ) -> tuple[Float[Array, "batch dimensions"], Float[Array, "batch 4*(height//14)-3 4*(width//14)-3 128"]]:
        """Global descriptors and local descriptors of unit length of preprocessed images."""
        maps = self.backbone(images).maps
        local = self.upsampling2(nnx.relu(self.upsampling1(maps)))
        return of_unit_length(self.pool(of_unit_length(maps))), of_unit_length(local)
