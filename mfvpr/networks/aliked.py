"""ALIKED (Zhao et al., IEEE TIM 2023): keypoints and descriptors from a light network with deformable convolutions.

Four blocks at full, 1/2, 1/8 and 1/32 resolution are brought to a common width, enlarged and laid side by side: a
feature for every pixel. Scaled to unit length, it is what descriptors are sampled from (`aliked_description`); four
small convolutions make a score of it, whose peaks are the keypoints (`aliked_detection`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array

from mfvpr.networks.aliked_description import DescriptorHead, field
from mfvpr.networks.aliked_detection import Detections, detect
from mfvpr.networks.sampling import sample, upsample
from mfvpr.utils.errors import InputError

STRIDE = 32  # px, of the coarsest map
_POOLED = (1, 2, 4, 4)  # before each block
_TOGETHER = 4  # pixels, which divides STRIDE


class Variant(NamedTuple):
    """Widths of a published network, and how many positions each descriptor is gathered from."""

    widths: tuple[int, int, int, int]
    dimension: int
    positions: int


VARIANTS = {
    "aliked-t16": Variant((8, 16, 32, 64), 64, 16),
    "aliked-n16": Variant((16, 32, 64, 128), 128, 16),
    "aliked-n16rot": Variant((16, 32, 64, 128), 128, 16),
    "aliked-n32": Variant((16, 32, 64, 128), 128, 32),
}


class DeformableConv(nnx.Module):
    """3 x 3 convolution whose nine taps move by what another convolution proposes; zeros outside, no bias."""

    def __init__(self, inputs: int, outputs: int, *, precision: str, rngs: nnx.Rngs) -> None:
        init = nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(init(rngs.params(), (3, 3, inputs, outputs)))
        self.offset = nnx.Conv(inputs, 18, (3, 3), padding=1, precision=precision, rngs=rngs)
        self.precision = precision

    def __call__(self, x: Array) -> Array:
        """`[B, h, w, inputs]` -> `[B, h, w, outputs]`. Taps move by a quarter of the longer side at most.

        One tap after the other: laying them side by side first costs several times the product.
        """
        height, width, inputs = x.shape[1:]
        limit = max(height, width) / 4
        moves = jnp.clip(self.offset(x), -limit, limit).reshape(*x.shape[:3], 9, 2)[..., ::-1]  # stored as (y, x)
        pixels = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), axis=-1)  # [h, w, 2] (x, y)
        shifts = jnp.stack(jnp.meshgrid(jnp.arange(-1, 2), jnp.arange(-1, 2)), axis=-1).reshape(9, 1, 1, 1, 2)
        points = (pixels[None, None] + shifts).astype(x.dtype) + jnp.moveaxis(moves, 3, 0)  # [9, B, h, w, 2]

        def add(total: Array, tap: tuple[Array, Array]) -> tuple[Array, None]:
            points, kernel = tap
            return total + jnp.matmul(jax.vmap(sample)(x, points), kernel, precision=self.precision), None

        kernels = self.kernel[...].reshape(9, inputs, -1)
        total = jnp.zeros((*x.shape[:3], kernels.shape[-1]), x.dtype)
        return jax.lax.scan(add, total, (points, kernels))[0]


class Block(nnx.Module):
    """Two 3 x 3 convolutions, each with batch normalization and SELU; a shortcut, if any, is added before the last."""

    def __init__(
        self, inputs: int, outputs: int, *, deformable: bool, shortcut: bool, precision: str, rngs: nnx.Rngs
    ) -> None:
        def conv(inputs: int, outputs: int) -> nnx.Module:
            if deformable:
                return DeformableConv(inputs, outputs, precision=precision, rngs=rngs)
            return _conv(inputs, outputs, precision=precision, rngs=rngs)

        self.conv1, self.conv2 = conv(inputs, outputs), conv(outputs, outputs)
        self.bn1, self.bn2 = (nnx.BatchNorm(outputs, use_running_average=True, rngs=rngs) for _ in range(2))
        self.shortcut = nnx.Conv(inputs, outputs, (1, 1), precision=precision, rngs=rngs) if shortcut else None

    def __call__(self, x: Array) -> Array:
        """`[B, h, w, inputs]` -> `[B, h, w, outputs]`."""
        out = self.bn2(self.conv2(nnx.selu(self.bn1(self.conv1(x)))))
        return nnx.selu(out if self.shortcut is None else out + self.shortcut(x))


class Aliked(nnx.Module):
    """The network without its detector, which has no weights.

    Args:
        variant: "aliked-t16", "aliked-n16", "aliked-n16rot" or "aliked-n32".
        precision: of the products where the hardware offers less than float32, which moves keypoints.

    Raises:
        InputError: there is no such variant.
    """

    def __init__(self, variant: str = "aliked-n16", *, precision: str = "highest", rngs: nnx.Rngs) -> None:
        if variant not in VARIANTS:
            raise InputError(f"ALIKED: expected one of {', '.join(VARIANTS)}, got {variant}")
        widths, self.dimension, positions = VARIANTS[variant]
        options = {"precision": precision, "rngs": rngs}
        inputs = 3
        for place, width in enumerate(widths, start=1):
            block = Block(inputs, width, deformable=place > 2, shortcut=place > 1, **options)
            setattr(self, f"block{place}", block)
            setattr(self, f"conv{place}", _conv(width, self.dimension // 4, 1, **options))
            inputs = width
        steps = ((self.dimension, 8, 1), (8, 4, 3), (4, 4, 3), (4, 1, 3))
        self.score_head = nnx.List([_conv(*step, **options) for step in steps])
        self.desc_head = DescriptorHead(self.dimension, positions, precision=precision, rngs=rngs)

    def __call__(self, images: Array) -> tuple[Array, Array]:
        """Features `[B, H, W, dimension]` of unit length, and scores `[B, H, W]` in (0, 1), of all pixels.

        Args:
            images: `[B, H, W, 3]` float32 RGB, 0 .. 1. Border pixels are repeated to make the sides multiples of 32.
        """
        levels, scores = self.levels(images)
        return jax.vmap(lambda levels: field(levels, *_inside(images)).dense())(levels), scores

    def levels(self, images: Array) -> tuple[list[Array], Array]:
        """What features are made of, `[B, h, w, dimension / 4]` at each resolution of the padded images; and scores."""
        (top, bottom), (left, right) = (_margins(size) for size in images.shape[1:3])
        x = jnp.pad(images, ((0, 0), (top, bottom), (left, right), (0, 0)), mode="edge")
        levels = []
        for place, pooled in enumerate(_POOLED, start=1):
            x = getattr(self, f"block{place}")(_average_pool(x, pooled))
            levels.append(nnx.selu(getattr(self, f"conv{place}")(x)))
        return levels, self._scores(levels)[:, *_inside(images)]

    def extract(self, images: Array, threshold: Array | float, capacity: int) -> tuple[Detections, Array]:
        """Keypoints of `images` as above, and their descriptors `[B, N, dimension]` of unit length."""
        levels, scores = self.levels(images)

        def of_one(levels: list[Array], scores: Array) -> tuple[Detections, Array]:
            found = detect(scores, threshold, capacity)
            return found, self.desc_head(field(levels, *_inside(images)), found.keypoints, found.count)

        return jax.vmap(of_one)(levels, scores)

    def _scores(self, levels: list[Array]) -> Array:
        """`[B, H, W]`.

        The first convolution, of single pixels, and the enlargement are linear: in this order, 8 channels are enlarged
        instead of all.
        """
        first, *others = self.score_head
        parts = jnp.split(first.kernel[0, 0], len(levels))
        total = jnp.zeros((), levels[0].dtype)
        for level, part in zip(levels, parts, strict=True):
            product = jnp.matmul(level, part, precision=first.precision)
            total += upsample(product, levels[0].shape[1] // level.shape[1])
        for conv in others:
            total = _narrow(conv, nnx.selu(total))
        return nnx.sigmoid(total[..., 0])


def _conv(inputs: int, outputs: int, size: int = 3, *, precision: str, rngs: nnx.Rngs) -> nnx.Conv:
    """Keeps the map's size; no bias."""
    return nnx.Conv(inputs, outputs, (size, size), padding=size // 2, use_bias=False, precision=precision, rngs=rngs)


def _narrow(conv: nnx.Conv, x: Array) -> Array:
    """`conv(x)`, 3 x 3 from few channels to few: `_TOGETHER` pixels of a row become one of many channels.

    The kernel grows with them, by zeros too. A CPU, which works on many channels at once, takes half of the time.
    """
    batch, height, width, inputs = x.shape
    block, source, target = np.indices((3, _TOGETHER, _TOGETHER))
    column = (block - 1) * _TOGETHER + source - target + 1  # of the kernel, from a pixel of a block to a pixel of ours
    chosen = (column[..., None] == np.arange(3)).astype(np.float32)
    kernel = jnp.einsum("bstx,yxio->ybsito", chosen, conv.kernel[...], precision=conv.precision)
    out = jax.lax.conv_general_dilated(
        x.reshape(batch, height, width // _TOGETHER, _TOGETHER * inputs),
        kernel.reshape(3, 3, _TOGETHER * inputs, -1),
        window_strides=(1, 1),
        padding="SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=conv.precision,
    )
    return out.reshape(batch, height, width, -1)


def _inside(images: Array) -> tuple[slice, slice]:
    """Where images `[B, H, W, 3]` lie within the padded ones."""
    (top, _), (left, _) = (_margins(size) for size in images.shape[1:3])
    return slice(top, top + images.shape[1]), slice(left, left + images.shape[2])


def _margins(size: int) -> tuple[int, int]:
    """Pixels to add before and after."""
    missing = -size % STRIDE
    return missing // 2, missing - missing // 2


def _average_pool(x: Array, factor: int) -> Array:
    batch, height, width, channels = x.shape
    return x.reshape(batch, height // factor, factor, width // factor, factor, channels).mean(axis=(2, 4))
