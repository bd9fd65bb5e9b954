"""ALIKED (Zhao et al., IEEE TIM 2023): keypoints and descriptors from a light network with deformable convolutions.

The outputs of four blocks at full, 1/2, 1/8 and 1/32 resolution are reduced to a common width, enlarged and
concatenated: a feature for each pixel. Four small convolutions turn the features into a score map, whose peaks are the
keypoints (`detect`). Descriptors are sampled from the features of unit length (`Field`, `DescriptorHead`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array
from mfvpr.networks import layers

STRIDE = 32  # px, of the coarsest map
RADIUS = 2  # px, of the suppression, the refinement and the border without keypoints
VARIANTS = {  # published networks: widths of the blocks, numbers and sampling positions of a descriptor
    "aliked-t16": ((8, 16, 32, 64), 64, 16),
    "aliked-n16": ((16, 32, 64, 128), 128, 16),
    "aliked-n16rot": ((16, 32, 64, 128), 128, 16),
    "aliked-n32": ((16, 32, 64, 128), 128, 32),
}
_POOLING = (1, 2, 4, 4)  # factors before the blocks
_PIXELS = 4  # per step of `_narrow`; divides STRIDE
_CHUNK = 256  # keypoints per step of the descriptors
_TEMPERATURE = 0.1  # of the refinement


class DeformableConv(nnx.Module):
    """3 x 3 convolution with offsets of its nine taps from another convolution; zeros outside, no bias."""

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs) -> None:
        self.kernel = nnx.Param(nnx.initializers.lecun_normal()(rngs.params(), (3, 3, inputs, outputs)))
        self.offset = layers.conv(inputs, 18, use_bias=True, rngs=rngs)

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
            return total + layers.matmul(layers.over_batch(layers.sample)(x, points), kernel), None

        kernels = self.kernel[...].reshape(9, inputs, -1)
        total = jnp.zeros((*x.shape[:3], kernels.shape[-1]), x.dtype)
        return jax.lax.scan(add, total, (points, kernels))[0]


class Block(nnx.Module):
    """Two 3 x 3 convolutions with batch normalization and SELU; an optional shortcut before the last SELU."""

    def __init__(self, inputs: int, outputs: int, *, deformable: bool, shortcut: bool, rngs: nnx.Rngs) -> None:
        convolution = DeformableConv if deformable else layers.conv
        self.conv1, self.conv2 = (convolution(width, outputs, rngs=rngs) for width in (inputs, outputs))
        self.bn1, self.bn2 = (layers.BatchNorm(outputs, rngs=rngs) for _ in range(2))
        self.shortcut = layers.conv(inputs, outputs, 1, use_bias=True, rngs=rngs) if shortcut else None

    def __call__(self, x: Float[Array, "batch height width inputs"]) -> Float[Array, "batch height width outputs"]:
        out = self.bn2(self.conv2(nnx.selu(self.bn1(self.conv1(x)))))
        return nnx.selu(out if self.shortcut is None else out + self.shortcut(x))


class Aliked(nnx.Module):
    """ALIKED's network. The detector has no weights and is not part of it.

    `variant` is "aliked-t16", "aliked-n16", "aliked-n16rot" or "aliked-n32".
    """

    def __init__(self, variant: str = "aliked-n16", *, rngs: nnx.Rngs) -> None:
        widths, self.dimension, positions = VARIANTS[variant]
        inputs = 3
        for place, width in enumerate(widths, start=1):
            setattr(self, f"block{place}", Block(inputs, width, deformable=place > 2, shortcut=place > 1, rngs=rngs))
            setattr(self, f"conv{place}", layers.conv(width, self.dimension // 4, 1, rngs=rngs))
            inputs = width
        steps = ((self.dimension, 8, 1), (8, 4, 3), (4, 4, 3), (4, 1, 3))
        self.score_head = nnx.List([layers.conv(*step, rngs=rngs) for step in steps])
        self.desc_head = DescriptorHead(self.dimension, positions, rngs=rngs)

    def extract(self, images: layers.Images, threshold: Array | float, capacity: int) -> layers.Detections:
        """Keypoints of RGB images, 0 .. 1, with their descriptors; each field has a leading axis `batch`."""
        levels, scores = self.levels(images)

        def extract_one(levels: list[Array], scores: Array) -> layers.Detections:
            detections, features = detect(scores, threshold, capacity), field(levels, *_inside(images))
            descriptors = self.desc_head(features, detections.keypoints, detections.count)
            return detections._replace(descriptors=descriptors)

        return layers.over_batch(extract_one)(levels, scores)

    def levels(self, images: layers.Images) -> tuple[list[Array], Float[Array, "batch height width"]]:
        """Parts of the features `[B, h, w, C]` at each resolution, and scores in (0, 1) of all pixels.

        Border pixels are repeated to make the sides multiples of 32. The parts are those of the padded images.
        """
        rows, columns = _inside(images)
        height, width = (-(-size // STRIDE) * STRIDE for size in images.shape[1:3])
        margins = (rows.start, height - rows.stop), (columns.start, width - columns.stop)
        x = jnp.pad(images, ((0, 0), *margins, (0, 0)), mode="edge")
        levels = []
        for place, factor in enumerate(_POOLING, start=1):
            batch, height, width, channels = x.shape
            x = x.reshape(batch, height // factor, factor, width // factor, factor, channels).mean(axis=(2, 4))
            x = getattr(self, f"block{place}")(x)
            levels.append(nnx.selu(getattr(self, f"conv{place}")(x)))
        # The first convolution (1 x 1) and the enlargement are linear: it runs first, so that 8 channels are enlarged.
        first, *convolutions = self.score_head
        scores = jnp.zeros((), levels[0].dtype)
        for level, part in zip(levels, jnp.split(first.kernel[0, 0], len(levels)), strict=True):
            scores += layers.stretch(layers.matmul(level, part), *levels[0].shape[1:3])
        for convolution in convolutions:
            scores = _narrow(convolution, nnx.selu(scores))
        return levels, nnx.sigmoid(scores[:, rows, columns, 0])


def _narrow(convolution: nnx.Conv, x: Array) -> Array:
    """`convolution(x)` of 3 x 3 px with few channels, computed on groups of `_PIXELS` pixels of a row.

    The pixels of a group become channels, and the kernel is padded with zeros. A CPU processes many channels at once,
    so this takes half of the time.
    """
    batch, height, width, inputs = x.shape
    group, source, target = np.indices((3, _PIXELS, _PIXELS))
    column = (group - 1) * _PIXELS + source - target + 1  # of the kernel, from pixel `source` of a group to `target`
    selection = (column[..., None] == np.arange(3)).astype(np.float32)
    kernel = jnp.einsum("bstx,yxio->ybsito", selection, convolution.kernel[...], precision=layers.PRECISION)
    kernel = kernel.reshape(3, 3, _PIXELS * inputs, -1)
    x = x.reshape(batch, height, width // _PIXELS, _PIXELS * inputs)
    axes = ("NHWC", "HWIO", "NHWC")
    out = jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=axes, precision=layers.PRECISION)
    return out.reshape(batch, height, width, -1)


def _inside(images: Array) -> tuple[slice, slice]:
    """Rows and columns of images within the padded images."""
    height, width = images.shape[1:3]
    top, left = (-size % STRIDE // 2 for size in (height, width))
    return slice(top, top + height), slice(left, left + width)


class Level(NamedTuple):
    """One map of a field, already enlarged in height; `columns` enlarge it in width."""

    rows: Float[Array, "height _ channels"]
    columns: layers.Neighbors | None  # None if the rows have full width


class Field(NamedTuple):
    """Features of all pixels, of unit length, computed only at requested pixels.

    Descriptors need about half of the pixels, and the features of 320 x 320 px take 52 MB.
    """

    levels: tuple[Level, ...]
    inverse_norm: Float[Array, "height width"]

    def at(self, y: Int[Array, " pixels"], x: Int[Array, " pixels"]) -> Float[Array, "pixels dimensions"]:
        """Features of pixels; 0 outside."""
        height, width = self.inverse_norm.shape
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        weight = jnp.where(inside, jnp.ones((), self.inverse_norm.dtype), 0)
        y, x = jnp.clip(y, 0, height - 1), jnp.clip(x, 0, width - 1)
        return jnp.concatenate(self._weighted_parts(y, x, weight), axis=-1)

    def sample(self, points: Float[Array, "points 2"]) -> Float[Array, "points dimensions"]:
        """Features at positions (x, y) px, bilinear; 0 outside."""
        corners = [self._weighted_parts(*corner) for corner in layers.around(points, *self.inverse_norm.shape)]
        return jnp.concatenate([sum(parts[1:], start=parts[0]) for parts in zip(*corners, strict=True)], axis=-1)

    def _weighted_parts(self, y: Array, x: Array, weight: Array) -> list[Float[Array, "pixels _"]]:
        """Parts of each level for the features of pixels inside the image, times `weight`."""
        # Sums of separate parts are several times faster than sums of concatenated features.
        weight *= _rows_at(self.inverse_norm.reshape(-1), y * self.inverse_norm.shape[1] + x)
        parts = []
        for rows, columns in self.levels:
            flat, start = rows.reshape(-1, rows.shape[-1]), y * rows.shape[1]
            if columns is None:
                parts.append(weight[:, None] * _rows_at(flat, start + x))
            else:
                lower, upper, part = (jnp.asarray(values)[x] for values in columns)
                before, after = _rows_at(flat, start + lower), _rows_at(flat, start + upper)
                parts.append((weight * (1 - part))[:, None] * before + (weight * part)[:, None] * after)
        return parts


def field(levels: Sequence[Float[Array, "_ _ channels"]], rows: slice, columns: slice) -> Field:
    """Field of levels, the first of full size, cropped to `rows` and `columns`."""
    height, width = levels[0].shape[:2]
    parts = [Level(levels[0][rows, columns], None)]
    for level in levels[1:]:
        down, right = layers.neighbors(level.shape[0], height, rows), layers.neighbors(level.shape[1], width, columns)
        parts.append(Level(layers.between(level, down, -3), right))
    wide = [part.rows if part.columns is None else layers.between(part.rows, part.columns, -2) for part in parts]
    squares = [jnp.sum(part * part, axis=-1) for part in wide]
    return Field(tuple(parts), 1 / jnp.maximum(jnp.sqrt(sum(squares[1:], start=squares[0])), layers.EPSILON))


def _rows_at(rows: Array, places: Array) -> Array:
    return rows.at[places].get(mode="promise_in_bounds")


class DescriptorHead(nnx.Module):
    """Samples features at `positions` places per keypoint, which depend on its 3 x 3 neighborhood."""

    def __init__(self, dimension: int, positions: int, *, rngs: nnx.Rngs) -> None:
        moves = 2 * positions
        self.offset1 = layers.conv(dimension, moves, use_bias=True, rngs=rngs)
        self.offset2 = layers.conv(moves, moves, 1, use_bias=True, rngs=rngs)
        self.sample = layers.conv(dimension, dimension, 1, rngs=rngs)
        initial = nnx.initializers.lecun_normal()
        self.agg_weights = nnx.Param(initial(rngs.params(), (positions, dimension, dimension)))

    def __call__(
        self, features: Field, keypoints: Float[Array, "slots 2"], count: int | Int[Array, ""]
    ) -> Float[Array, "slots dimensions"]:
        """Descriptors of unit length of keypoints (x, y) px; only the first `count` are valid.

        Runs chunk by chunk, so that unused slots cost nothing.
        """
        slots, dimension = len(keypoints), self.agg_weights.shape[-1]
        keypoints = jnp.pad(keypoints, ((0, -slots % _CHUNK), (0, 0)))

        def describe(chunk: Array, descriptors: Array) -> Array:
            start = chunk * _CHUNK
            new = self._describe(features, jax.lax.dynamic_slice_in_dim(keypoints, start, _CHUNK))
            return jax.lax.dynamic_update_slice_in_dim(descriptors, new, start, axis=0)

        chunks = -(-jnp.minimum(count, slots) // _CHUNK)
        start = jnp.zeros((len(keypoints), dimension), keypoints.dtype)
        return jax.lax.fori_loop(0, chunks, describe, start)[:slots]

    def _describe(self, features: Field, keypoints: Array) -> Float[Array, "slots dimensions"]:
        """Descriptors of all keypoints, place by place, so that intermediate values stay in the CPU's caches."""

        def add(total: Array, place: tuple[Array, Array]) -> tuple[Array, None]:
            move, mixing = place
            sampled = nnx.selu(layers.matmul(features.sample(keypoints + move), self.sample.kernel[0, 0]))
            return total + layers.matmul(sampled, mixing), None

        start = jnp.zeros((len(keypoints), self.agg_weights.shape[-1]), keypoints.dtype)
        descriptors, _ = jax.lax.scan(add, start, (self._moves(features, keypoints), self.agg_weights[...]))
        return layers.of_unit_length(descriptors)

    def _moves(self, features: Field, keypoints: Float[Array, "slots 2"]) -> Float[Array, "positions slots 2"]:
        """Offsets (x, y) px of the places, a quarter of the longer side at most.

        Neighborhoods beyond the border are zero, as in the original's compiled operator. (The original's fallback in
        Python moves them inside instead.)
        """
        column, row = keypoints.astype(int).T  # truncated
        reach = jnp.arange(-1, 2)
        steps = jnp.stack(jnp.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(9, 2)

        def add(total: Array, neighbor: tuple[Array, Array]) -> tuple[Array, None]:
            step, kernel = neighbor
            return total + layers.matmul(features.at(row + step[0], column + step[1]), kernel), None

        kernels = self.offset1.kernel[...].reshape(9, -1, self.offset1.out_features)
        hidden, _ = jax.lax.scan(add, jnp.zeros((len(keypoints), kernels.shape[-1]), keypoints.dtype), (steps, kernels))
        hidden = nnx.selu(hidden + layers.bias_of(self.offset1)[None])
        moves = layers.matmul(hidden, self.offset2.kernel[0, 0]) + layers.bias_of(self.offset2)[None]
        limit = max(features.inverse_norm.shape) / 4
        return jnp.clip(moves, -limit, limit).reshape(len(keypoints), 2, -1).transpose(2, 0, 1)


def detect(score_map: Float[Array, "height width"], threshold: Array | float, capacity: int) -> layers.Detections:
    """Peaks of a map above `threshold`, refined to fractions of a pixel, in min(capacity, height * width) slots.

    They are ordered by row, or by score if there are more than slots. If no peak is above it, or `threshold` is 0, the
    map's mean is the threshold. (The original takes the mean if the whole batch has no peak.)
    """
    width = score_map.shape[1]
    scores, peaks = score_map.reshape(-1), _peaks(score_map).reshape(-1)
    above = peaks & (scores > threshold) & (threshold > 0)
    valid = jnp.where(jnp.any(above), above, peaks & (scores > jnp.mean(scores)))
    count = jnp.sum(valid)
    capacity = min(capacity, valid.size)
    row_order = -jnp.arange(valid.size, dtype=scores.dtype)
    key, place = jax.lax.top_k(jnp.where(valid, jnp.where(count > capacity, scores, row_order), -jnp.inf), capacity)
    keypoints = _refine(score_map, place // width, place % width)
    return layers.Detections(keypoints, layers.sample(score_map[..., None], keypoints)[..., 0], key > -jnp.inf, count)


def _peaks(scores: Float[Array, "height width"]) -> Bool[Array, "height width"]:
    """Local maxima, and in two more rounds those outside the neighborhoods of maxima; no border."""
    is_peak = scores == layers.local_maximum(scores, RADIUS)
    for _ in range(2):
        suppressed = layers.local_maximum(is_peak, RADIUS)
        remaining = jnp.where(suppressed, 0, scores)
        is_peak |= (remaining == layers.local_maximum(remaining, RADIUS)) & ~suppressed
    inside = [(jnp.arange(size) >= RADIUS) & (jnp.arange(size) < size - RADIUS) for size in scores.shape]
    return is_peak & inside[0][:, None] & inside[1][None, :]


def _refine(score_map: Array, row: Array, column: Array) -> Float[Array, "slots 2"]:
    """Mean position (x, y) px around each peak, weighted by a softmax of the scores."""
    height, width = score_map.shape
    reach = jnp.arange(2 * RADIUS + 1)
    padded = jnp.pad(score_map, RADIUS)
    patches = padded[row[:, None, None] + reach[None, :, None], column[:, None, None] + reach[None, None, :]]
    weights = jnp.exp((patches - jnp.max(patches, axis=(1, 2), keepdims=True)) / _TEMPERATURE)
    total = jnp.sum(weights, axis=(1, 2))
    away = (reach - RADIUS).astype(weights.dtype)
    x = column.astype(weights.dtype) + jnp.sum(weights * away[None, None, :], axis=(1, 2)) / total
    y = row.astype(weights.dtype) + jnp.sum(weights * away[None, :, None], axis=(1, 2)) / total
    return jnp.stack([_there_and_back(x, width, total), _there_and_back(y, height, total)], axis=-1)


def _there_and_back(position: Array, size: int, total: Array) -> Array:
    """Scale a position to [-1, 1] and back, with the rounding of the original.

    Whole numbers may become a little smaller, and the descriptor truncates them. For a divisor that all positions
    share, XLA multiplies by the reciprocal, which rounds differently. A divisor that depends on `total` prevents this:
    `total` is always positive, which XLA cannot know.
    """
    last = jnp.where(total > 0, jnp.asarray(size - 1, position.dtype), 1)
    return ((position / last * 2 - 1) / 2 + 0.5) * last
