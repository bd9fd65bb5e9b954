"""XFeat (Potje et al., CVPR 2024): keypoints and descriptors from a network of few channels, for fast extraction.

The network takes a gray image of mean 0 and variance 1. A backbone with maps at 1/4 to 1/32 of its resolution gives
each cell of 8 x 8 px a descriptor and its reliability. 1 x 1 convolutions over the 64 pixels of a cell give the
probabilities that a pixel is a keypoint, or none of them. The local maxima of this map are the keypoints.

Positions of keypoints on the maps are those of the public code: `grid_sample` without aligned corners, but positions
scaled by the last pixel. So the maps are stretched by a pixel, and values fade to 0 at the border.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import lax
from jaxtyping import Float, Int

from mfvpr.core.types import Array
from mfvpr.networks import layers

STRIDE = 32  # px, of the coarsest map
CELL = 8  # px, of the maps of descriptors, reliability and keypoints
RADIUS = 2  # px, of the suppression
DIMENSION = 64  # of the descriptors
_EPSILON = 1e-5  # added to variances
_CUBIC = -0.75  # the constant of Keys (1981) that PyTorch and OpenCV take
_WIDE = 24  # least input channels for which Winograd's method is faster on a CPU


class Layer(nnx.Module):
    """Convolution, batch normalization without scale and shift, ReLU.

    `model.set_attributes(is_direct=True)`: XLA's own convolutions on every device, as exporters to ONNX need them.
    """

    def __init__(self, inputs: int, outputs: int, size: int = 3, stride: int = 1, *, rngs: nnx.Rngs) -> None:
        self.stride, self.is_direct = stride, False
        self.conv = (
            layers.conv(inputs, outputs, stride=stride, rngs=rngs)
            if size == 3
            else layers.Linear(inputs, outputs, use_bias=False, rngs=rngs)
        )
        self.norm = layers.BatchNorm(outputs, use_scale=False, use_bias=False, rngs=rngs)

    def __call__(self, x: Float[Array, "batch height width inputs"]) -> Float[Array, "batch _ _ outputs"]:
        return nnx.relu(self.norm(self._convolve(x)))

    def _convolve(self, x: Array) -> Array:
        """Convolve a map. On a CPU, XLA's own convolution takes 2 to 20 times as long for up to 4 channels."""
        if isinstance(self.conv, nnx.Linear) or self.is_direct:
            return self.conv(x)
        if x.shape[-1] <= 4:
            fast = partial(_sum_of_shifts, stride=self.stride)
        elif x.shape[-1] >= _WIDE and self.stride == 1:
            fast = partial(layers.winograd, dilation=1)
        else:
            return self.conv(x)
        return lax.platform_dependent(x, self.conv.kernel[...], cpu=fast, default=lambda x, _: self.conv(x))


def _sum_of_shifts(x: Array, kernel: Array, stride: int) -> Array:
    x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    channels = range(x.shape[-1])
    parts = [layers.sum_of_shifts(x[..., i : i + 1], kernel[:, :, i : i + 1], stride) for i in channels]
    return sum(parts[1:], start=parts[0])


class XFeat(nnx.Module):
    """XFeat's network without the refinement of matches; the detector has no weights and is not part of it."""

    dimension = DIMENSION

    def __init__(self, *, rngs: nnx.Rngs) -> None:
        def stack(*shapes: tuple[int, ...], outputs: int | None = None) -> nnx.List:
            last = [] if outputs is None else [layers.Linear(64, outputs, rngs=rngs)]
            return nnx.List([Layer(*shape, rngs=rngs) for shape in shapes] + last)

        self.skip1 = layers.Linear(1, 24, rngs=rngs)
        self.block1 = stack((1, 4), (4, 8, 3, 2), (8, 8), (8, 24, 3, 2))
        self.block2 = stack((24, 24), (24, 24))
        self.block3 = stack((24, 64, 3, 2), (64, 64), (64, 64, 1))
        self.block4 = stack((64, 64, 3, 2), (64, 64), (64, 64))
        self.block5 = stack((64, 128, 3, 2), (128, 128), (128, 128), (128, 64, 1))
        self.block_fusion = stack((64, 64), (64, 64), outputs=DIMENSION)
        self.heatmap_head = stack((64, 64, 1), (64, 64, 1), outputs=1)
        self.keypoint_head = stack((64, 64, 1), (64, 64, 1), (64, 64, 1), outputs=CELL**2 + 1)

    def extract(self, images: layers.Images, threshold: Array | float, capacity: int) -> layers.Detections:
        """Keypoints of RGB images, 0 .. 1, with their descriptors; each field has a leading axis `batch`."""

        def extract_one(descriptors: Array, reliability: Array, heatmap: Array) -> layers.Detections:
            detections = detect(heatmap, reliability, threshold, capacity)
            pixels = detections.keypoints.astype(int)
            return detections._replace(descriptors=sample_descriptors(descriptors, pixels, heatmap.shape))

        return layers.over_batch(extract_one)(*self.maps(images))

    def maps(
        self, images: layers.Images
    ) -> tuple[
        Float[Array, "batch rows columns dimensions"],
        Float[Array, "batch rows columns"],
        Float[Array, "batch height width"],
    ]:
        """Descriptors of unit length and their reliability for each cell, and a keypoint probability for each pixel."""
        batch, height, width, _ = images.shape
        gray = ((images[..., 0] + images[..., 1] + images[..., 2]) / 3)[..., None]  # 20 times as fast as a reduction
        x = gray - _mean(gray)
        x *= lax.rsqrt(_mean(x * x) + _EPSILON)
        pooled = x.reshape(batch, height // 4, 4, width // 4, 4, 1).mean(axis=(2, 4))
        cells = x.reshape(batch, height // CELL, CELL, width // CELL, CELL).transpose(0, 1, 3, 2, 4)
        cells = cells.reshape(*cells.shape[:3], CELL**2)

        coarse = _run(self.block3, _run(self.block2, _run(self.block1, x) + self.skip1(pooled)))
        coarser = _run(self.block4, coarse)
        coarsest = _run(self.block5, coarser)
        resize = partial(jax.image.resize, shape=coarse.shape, method="bilinear", precision=lax.Precision.HIGHEST)
        features = _run(self.block_fusion, coarse + resize(coarser) + resize(coarsest))

        probabilities = nnx.softmax(_run(self.keypoint_head, cells))[..., :-1]  # without that of no keypoint
        heatmap = probabilities.reshape(*cells.shape[:3], CELL, CELL).transpose(0, 1, 3, 2, 4)
        reliability = nnx.sigmoid(_run(self.heatmap_head, features)[..., 0])
        return layers.of_unit_length(features), reliability, heatmap.reshape(batch, height, width)


def _run(stack: nnx.List, x: Array) -> Array:
    for layer in stack:
        x = layer(x)
    return x


def _mean(images: Array) -> Array:
    """Mean of each image. The mean of the rows' means has a hundredth of the rounding error."""
    return jnp.mean(jnp.mean(images, axis=2, keepdims=True), axis=1, keepdims=True)


def detect(
    heatmap: Float[Array, "height width"],
    reliability: Float[Array, "rows columns"],
    threshold: Array | float,
    capacity: int,
) -> layers.Detections:
    """Local maxima above `threshold`, by falling score, in min(capacity, height * width) slots.

    The score is the maximum times the reliability. The last row and column, and the first pixel, have no keypoints: the
    public code samples the last ones outside the map, and takes the first for padding.
    """
    height, width = heatmap.shape
    scores = heatmap * sample_all(sample_all(reliability, height).T, width).T
    is_peak = (heatmap == layers.local_maximum(heatmap, RADIUS)) & (heatmap > threshold) & (scores > 0)
    is_peak = is_peak.at[0, 0].set(False).at[-1].set(False).at[:, -1].set(False).reshape(-1)
    key, place = lax.top_k(jnp.where(is_peak, scores.reshape(-1), -jnp.inf), min(capacity, is_peak.size))
    keypoints = jnp.stack([place % width, place // width], axis=-1).astype(heatmap.dtype)
    mask = key > -jnp.inf
    return layers.Detections(keypoints, jnp.where(mask, key, 0), mask, jnp.sum(is_peak))


def sample_all(dense: Float[Array, "cells columns"], size: int) -> Float[Array, "{size} columns"]:
    """Values at all pixels of a line of `size`, linear."""
    places, weights = taps(size, len(dense), cubic=False)
    return weights[:, :1] * dense[places[:, 0]] + weights[:, 1:] * dense[places[:, 1]]


def sample_descriptors(
    descriptors: Float[Array, "rows columns dimensions"], pixels: Int[Array, "slots 2"], shape: tuple[int, int]
) -> Float[Array, "slots dimensions"]:
    """Descriptors of unit length at pixels (x, y) of an image of `shape` (height, width), bicubic."""
    rows, columns, dimensions = descriptors.shape
    (down, along), (right, across) = (
        [jnp.asarray(table)[place] for table in taps(size, cells, cubic=True)]
        for place, size, cells in ((pixels[:, 1], shape[0], rows), (pixels[:, 0], shape[1], columns))
    )
    flat = descriptors.reshape(-1, dimensions)
    total = jnp.zeros((len(pixels), dimensions), descriptors.dtype)
    for i, j in np.ndindex(4, 4):
        values = flat.at[down[:, i] * columns + right[:, j]].get(mode="promise_in_bounds")
        total += (along[:, i] * across[:, j])[:, None] * values
    return layers.of_unit_length(total)


def positions(size: int, cells: int) -> Float[np.ndarray, " size"]:
    """Positions of an image's pixels on a line of `cells`, rounded as PyTorch rounds them."""
    grid = np.float32(2) * (np.arange(size, dtype=np.float32) / np.float32(size - 1)) - np.float32(1)
    return ((grid + np.float32(1)) * np.float32(cells) - np.float32(1)) / np.float32(2)


def taps(size: int, cells: int, *, cubic: bool) -> tuple[Int[np.ndarray, "size _"], Float[np.ndarray, "size _"]]:
    """The two or four cells around each pixel's position, and their weights: 0 of cells outside."""
    position = positions(size, cells)
    steps = np.arange(-1, 3) if cubic else np.arange(2)
    places = np.floor(position).astype(int)[:, None] + steps
    away = np.abs(position[:, None].astype(np.float64) - places)
    a = _CUBIC
    near = ((a + 2) * away - (a + 3)) * away**2 + 1
    far = ((away - 5) * away + 8) * away * a - 4 * a
    weights = np.where(away <= 1, near, far) if cubic else 1 - away
    inside = (places >= 0) & (places < cells)
    return np.clip(places, 0, cells - 1), np.where(inside, weights, 0).astype(np.float32)
