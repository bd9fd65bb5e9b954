"""SelaVPR (Lu et al., ICLR 2024): DINOv2 with adapters, its generalized mean, and a dense map of local features."""

import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.networks.gem import GeneralizedMean
from mfvpr.networks.lengths import of_unit_length
from mfvpr.networks.vit import Block, VisionTransformer

_PARALLEL = 0.2  # how much the parallel adapter counts
_BOTTLENECK = 2  # how many times fewer hidden values an adapter has
_HIDDEN, LOCAL = 256, 128  # channels of the two upsampled maps


class Adapter(nnx.Module):
    """Two linear layers with half as many hidden values, ReLU between."""

    def __init__(self, width: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.down = nnx.Linear(width, width // _BOTTLENECK, precision=precision, rngs=rngs)
        self.up = nnx.Linear(width // _BOTTLENECK, width, precision=precision, rngs=rngs)

    def __call__(self, x: Array) -> Array:
        """`[B, N, D]` -> `[B, N, D]`."""
        return self.up(nnx.relu(self.down(x)))


class AdaptedBlock(Block):
    """A block with one adapter behind its attention, and one beside its perceptron."""

    def __init__(self, width: int, heads: int, *, precision: str, rngs: nnx.Rngs) -> None:
        super().__init__(width, heads, precision=precision, rngs=rngs)
        self.serial, self.parallel = (Adapter(width, precision=precision, rngs=rngs) for _ in range(2))

    def attended(self, x: Array) -> Array:
        """The attention z, and what the adapter makes of it: z + adapter(z)."""
        seen = super().attended(x)
        return seen + self.serial(seen)

    def transformed(self, x: Array) -> Array:
        """The perceptron and a fifth of the adapter, both of x."""
        return super().transformed(x) + _PARALLEL * self.parallel(x)


class Upsampling(nnx.Module):
    """Transposed 3 x 3 convolution, stride 2, padding 1: `[B, h, w, C]` -> `[B, 2 h - 1, 2 w - 1, D]`.

    `kernel` `[3, 3, C, D]`: what position (i, j) adds to the position (2 i + row - 1, 2 j + column - 1); `bias` `[D]`.
    """

    def __init__(self, inputs: int, outputs: int, *, precision: str, rngs: nnx.Rngs) -> None:
        initial = nnx.initializers.he_normal()
        self.kernel = nnx.Param(initial(rngs.params(), (3, 3, inputs, outputs), jnp.float32))
        self.bias = nnx.Param(jnp.zeros(outputs, jnp.float32))
        self.precision = precision

    def __call__(self, x: Array) -> Array:
        """One product with all of the kernel, then sums of neighbors: no zeros between positions are multiplied."""
        parts = jnp.tensordot(x, self.kernel[...], axes=(3, 2), precision=self.precision)  # [B, h, w, 3, 3, D]
        rows = _interleaved(parts, axis=1, kernel_axis=3)
        return _interleaved(rows, axis=2, kernel_axis=3) + self.bias[...][None, None, None]


def _interleaved(parts: Array, axis: int, kernel_axis: int) -> Array:
    """n positions, each with what it adds to the three around it -> 2 n - 1."""
    before, here, after = (jnp.take(parts, place, axis=kernel_axis) for place in range(3))
    last = here.shape[axis] - 1
    between = _part(after, 0, last, axis) + _part(before, 1, last + 1, axis)
    pairs = jnp.stack([_part(here, 0, last, axis), between], axis=axis + 1)
    merged = pairs.reshape(*pairs.shape[:axis], 2 * last, *pairs.shape[axis + 2 :])
    return jnp.concatenate([merged, _part(here, last, last + 1, axis)], axis=axis)


def _part(values: Array, start: int, stop: int, axis: int) -> Array:
    return jnp.take(values, jnp.arange(start, stop), axis=axis)


class SelaVpr(nnx.Module):
    """What the public code extracts: a global descriptor, and local ones four to a patch, less at the edges.

    Args:
        width: of the transformer, see `VisionTransformer`; that of ViT-L is published.
        depth: its blocks.
        heads: of its attention.
        registers: its further tokens; 4 in the variant with registers.
        precision: of the products where the hardware offers less than float32.
    """

    def __init__(
        self, width: int = 1024, depth: int = 24, heads: int = 16, *, registers: int = 0, precision: str = "highest",
        rngs: nnx.Rngs,
    ) -> None:  # fmt: skip
        self.backbone = VisionTransformer(
            width, depth, heads, registers=registers, block=AdaptedBlock, precision=precision, rngs=rngs
        )
        self.pool = GeneralizedMean()
        self.upsampling1 = Upsampling(width, _HIDDEN, precision=precision, rngs=rngs)
        self.upsampling2 = Upsampling(_HIDDEN, LOCAL, precision=precision, rngs=rngs)
        self.dimension = width

    preprocess = staticmethod(VisionTransformer.preprocess)

    def __call__(self, images: Array) -> tuple[Array, Array]:
        """Of preprocessed images `[B, 14 h, 14 w, 3]`: descriptors `[B, D]`, and `[B, 4 h - 3, 4 w - 3, 128]`.

        All are of unit length.
        """
        maps = self.backbone(images).maps
        local = self.upsampling2(nnx.relu(self.upsampling1(maps)))
        return of_unit_length(self.pool(of_unit_length(maps))), of_unit_length(local)
