"""ALIKED (Zhao et al., IEEE TIM 2023): keypoints and descriptors from a light network with deformable convolutions.

The outputs of four blocks at full, 1/2, 1/8 and 1/32 resolution are reduced to a common width, enlarged and
concatenated: a feature for each pixel. Descriptors are sampled from the features of unit length (`aliked_description`).
Four small convolutions turn the features into a score map, whose peaks are the keypoints (`aliked_detection`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.aliked_description import DescriptorHead, field
from mfvpr.networks.aliked_detection import Detections, detect
from mfvpr.networks.imagenet import Images
from mfvpr.networks.sampling import sample, upsample
from mfvpr.utils.errors import InputError

STRIDE = 32  # px, of the coarsest map
_POOLING = (1, 2, 4, 4)  # factors before the blocks
_PIXELS = 4  # per step of `_narrow`; divides STRIDE


VARIANTS = {  # published networks: widths of the blocks, numbers and sampling positions of a descriptor
    "aliked-t16": ((8, 16, 32, 64), 64, 16),
    "aliked-n16": ((16, 32, 64, 128), 128, 16),
    "aliked-n16rot": ((16, 32, 64, 128), 128, 16),
    "aliked-n32": ((16, 32, 64, 128), 128, 32),
}


class DeformableConv(nnx.Module):
    """3 x 3 convolution with offsets of its nine taps from another convolution; zeros outside, no bias."""

    def __init__(self, inputs: int, outputs: int, *, precision: str, rngs: nnx.Rngs) -> None:
        init = nnx.initializers.lecun_normal()
        self.kernel = nnx.Param(init(rngs.params(), (3, 3, inputs, outputs)))
        self.offset = nnx.Conv(inputs, 18, (3, 3), padding=1, precision=precision, rngs=rngs)
        self.precision = precision

    def __call__(self, x: Float[Array, "batch height width inputs"]) -> Float[Array, "batch height width outputs"]:
        """Convolve a map; taps move by a quarter of the longer side at most.

        Adds one tap after the other: concatenating the samples of all taps takes several times longer.
        """
        height, width, inputs = x.shape[1:]
        limit = max(height, width) / 4
        moves = jnp.clip(self.offset(x), -limit, limit).reshape(*x.shape[:3], 9, 2)[..., ::-1]  # stored as (y, x)
        pixels = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), axis=-1)  # [h, w, 2] (x, y)
        shifts = jnp.stack(jnp.meshgrid(jnp.arange(-1, 2), jnp.arange(-1, 2)), axis=-1).reshape(9, 1, 1, 1, 2)
        points = (pixels[None, None] + shifts).astype(x.dtype) + jnp.moveaxis(moves, 3, 0)  # [9, B, h, w, 2]

        def add(total: Array, tap: tuple[Array, Array]) -> tuple[Array, None]:
            points, kernel = tap
            return total + jnp.matmul(_over_batch(sample)(x, points), kernel, precision=self.precision), None

        kernels = self.kernel[...].reshape(9, inputs, -1)
        total = jnp.zeros((*x.shape[:3], kernels.shape[-1]), x.dtype)
        return jax.lax.scan(add, total, (points, kernels))[0]


class Block(nnx.Module):
    """Two 3 x 3 convolutions with batch normalization and SELU; an optional shortcut before the last SELU."""

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

    def __call__(self, x: Float[Array, "batch height width inputs"]) -> Float[Array, "batch height width outputs"]:
        out = self.bn2(self.conv2(nnx.selu(self.bn1(self.conv1(x)))))
        return nnx.selu(out if self.shortcut is None else out + self.shortcut(x))


class Aliked(nnx.Module):
    """ALIKED's network. The detector has no weights and is not part of it.

    Args:
        variant: "aliked-t16", "aliked-n16", "aliked-n16rot" or "aliked-n32".

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

    def __call__(
        self, images: Images
    ) -> tuple[Float[Array, "batch height width dimensions"], Float[Array, "batch height width"]]:
        """Features of unit length and scores in (0, 1) of all pixels of RGB images, 0 .. 1.

        Border pixels are repeated to make the sides multiples of 32.
        """
        levels, scores = self.levels(images)
        return jax.vmap(lambda levels: field(levels, *_inside(images)).dense())(levels), scores

    def levels(
        self, images: Images
    ) -> tuple[list[Float[Array, "batch _ _ channels"]], Float[Array, "batch height width"]]:
        """Parts of the features at each resolution of the padded images, and scores."""
        (top, bottom), (left, right) = (_margins(size) for size in images.shape[1:3])
        x = jnp.pad(images, ((0, 0), (top, bottom), (left, right), (0, 0)), mode="edge")
        levels = []
        for place, factor in enumerate(_POOLING, start=1):
            x = getattr(self, f"block{place}")(_average_pool(x, factor))
            levels.append(nnx.selu(getattr(self, f"conv{place}")(x)))
        return levels, self._scores(levels)[:, *_inside(images)]

    def extract(
        self, images: Images, threshold: Array | float, capacity: int
    ) -> tuple[Detections, Float[Array, "batch slots dimensions"]]:
        """Keypoints of images, and their descriptors of unit length."""
        levels, scores = self.levels(images)

        def extract_one(levels: list[Array], scores: Array) -> tuple[Detections, Array]:
            detections = detect(scores, threshold, capacity)
            return detections, self.desc_head(field(levels, *_inside(images)), detections.keypoints, detections.count)

        return _over_batch(extract_one)(levels, scores)

    def _scores(self, levels: list[Array]) -> Float[Array, "batch height width"]:
        """Scores of the padded images."""
        # The first convolution (1 x 1) and the enlargement are linear: it runs first, so that 8 channels are enlarged.
        first, *convolutions = self.score_head
        parts = jnp.split(first.kernel[0, 0], len(levels))
        total = jnp.zeros((), levels[0].dtype)
        for level, part in zip(levels, parts, strict=True):
            product = jnp.matmul(level, part, precision=first.precision)
            total += upsample(product, levels[0].shape[1] // level.shape[1])
        for conv in convolutions:
            total = _narrow(conv, nnx.selu(total))
        return nnx.sigmoid(total[..., 0])


def _conv(inputs: int, outputs: int, size: int = 3, *, precision: str, rngs: nnx.Rngs) -> nnx.Conv:
    """Convolution without bias that keeps the size of a map."""
    return nnx.Conv(inputs, outputs, (size, size), padding=size // 2, use_bias=False, precision=precision, rngs=rngs)


def _narrow(conv: nnx.Conv, x: Array) -> Array:
    """`conv(x)` for a 3 x 3 convolution with few channels, computed on groups of `_PIXELS` pixels of a row.

    The pixels of a group become channels, and the kernel is padded with zeros. A CPU processes many channels at once,
    so this takes half of the time.
    """
    batch, height, width, inputs = x.shape
    group, source, target = np.indices((3, _PIXELS, _PIXELS))
    column = (group - 1) * _PIXELS + source - target + 1  # of the kernel, from pixel `source` of a group to `target`
    selection = (column[..., None] == np.arange(3)).astype(np.float32)
    kernel = jnp.einsum("bstx,yxio->ybsito", selection, conv.kernel[...], precision=conv.precision)
    out = jax.lax.conv_general_dilated(
        x.reshape(batch, height, width // _PIXELS, _PIXELS * inputs),
        kernel.reshape(3, 3, _PIXELS * inputs, -1),
        window_strides=(1, 1),
        padding="SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=conv.precision,
    )
    return out.reshape(batch, height, width, -1)


def _inside(images: Array) -> tuple[slice, slice]:
    """Rows and columns of images within the padded images."""
    (top, _), (left, _) = (_margins(size) for size in images.shape[1:3])
    return slice(top, top + images.shape[1]), slice(left, left + images.shape[2])


def _margins(size: int) -> tuple[int, int]:
    """Pixels of padding before and after a side of this size."""
    missing = -size % STRIDE
    return missing // 2, missing - missing // 2


def _average_pool(x: Array, factor: int) -> Array:
    batch, height, width, channels = x.shape
    return x.reshape(batch, height // factor, factor, width // factor, factor, channels).mean(axis=(2, 4))


def _over_batch(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.vmap(function)`; a batch of one goes without it, which takes a third of the time to trace."""

    def call(*batch: Any) -> Any:
        if len(jax.tree.leaves(batch)[0]) != 1:
            return jax.vmap(function)(*batch)
        return jax.tree.map(lambda leaf: leaf[None], function(*jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], batch)))

    return call
