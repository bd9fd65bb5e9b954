"""ALIKED's descriptors of the keypoints of one image."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float, Int

from mfvpr.core.types import Array
from mfvpr.networks.imagenet import EPSILON, of_unit_length
from mfvpr.networks.sampling import Neighbors, around, between, neighbors

_CHUNK = 256  # keypoints per step


class Level(NamedTuple):
    """One map of a field, already enlarged in height; `columns` enlarge it in width."""

    rows: Float[Array, "height _ channels"]
    columns: Neighbors | None  # None if the rows have full width


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
        corners = [self._weighted_parts(*corner) for corner in around(points, *self.inverse_norm.shape)]
        return jnp.concatenate([sum(parts[1:], start=parts[0]) for parts in zip(*corners, strict=True)], axis=-1)

    def _weighted_parts(
        self, y: Int[Array, " pixels"], x: Int[Array, " pixels"], weight: Float[Array, " pixels"]
    ) -> list[Float[Array, "pixels _"]]:
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

    def dense(self) -> Float[Array, "height width dimensions"]:
        """All features."""
        return jnp.concatenate(_enlarge(self.levels), axis=-1) * self.inverse_norm[..., None]


def field(levels: Sequence[Float[Array, "_ _ channels"]], rows: slice, columns: slice) -> Field:
    """Field of levels, the first of full size, cropped to `rows` and `columns`."""
    height, width = levels[0].shape[:2]
    parts = [Level(levels[0][rows, columns], None)]
    for level in levels[1:]:
        down, right = neighbors(level.shape[0], height, rows), neighbors(level.shape[1], width, columns)
        parts.append(Level(between(level, down, -3), right))
    squares = [jnp.sum(part * part, axis=-1) for part in _enlarge(parts)]
    return Field(tuple(parts), 1 / jnp.maximum(jnp.sqrt(sum(squares[1:], start=squares[0])), EPSILON))


def _enlarge(levels: Sequence[Level]) -> list[Array]:
    return [rows if columns is None else between(rows, columns, -2) for rows, columns in levels]


class DescriptorHead(nnx.Module):
    """Samples features at `positions` places per keypoint, which depend on its 3 x 3 neighborhood."""

    def __init__(self, dimension: int, positions: int, *, precision: str, rngs: nnx.Rngs) -> None:
        moves = 2 * positions
        self.offset1 = nnx.Conv(dimension, moves, (3, 3), padding="VALID", precision=precision, rngs=rngs)
        self.offset2 = nnx.Conv(moves, moves, (1, 1), precision=precision, rngs=rngs)
        self.sample = nnx.Conv(dimension, dimension, (1, 1), use_bias=False, precision=precision, rngs=rngs)
        init = nnx.initializers.lecun_normal()
        self.agg_weights = nnx.Param(init(rngs.params(), (positions, dimension, dimension)))
        self.precision = precision

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

    def _describe(self, features: Field, keypoints: Float[Array, "slots 2"]) -> Float[Array, "slots dimensions"]:
        """Descriptors of all keypoints, place by place, so that intermediate values stay in the CPU's caches."""

        def add(total: Array, place: tuple[Array, Array]) -> tuple[Array, None]:
            move, mixing = place
            sampled = nnx.selu(self._product(features.sample(keypoints + move), self.sample.kernel[0, 0]))
            return total + self._product(sampled, mixing), None

        start = jnp.zeros((len(keypoints), self.agg_weights.shape[-1]), keypoints.dtype)
        descriptors, _ = jax.lax.scan(add, start, (self._moves(features, keypoints), self.agg_weights[...]))
        return of_unit_length(descriptors)

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
            return total + self._product(features.at(row + step[0], column + step[1]), kernel), None

        kernels = self.offset1.kernel[...].reshape(9, -1, self.offset1.out_features)
        hidden, _ = jax.lax.scan(add, jnp.zeros((len(keypoints), kernels.shape[-1]), keypoints.dtype), (steps, kernels))
        hidden = nnx.selu(hidden + _bias(self.offset1))
        moves = self._product(hidden, self.offset2.kernel[0, 0]) + _bias(self.offset2)
        limit = max(features.inverse_norm.shape) / 4
        return jnp.clip(moves, -limit, limit).reshape(len(keypoints), 2, -1).transpose(2, 0, 1)

    def _product(self, left: Array, right: Array) -> Array:
        return jnp.matmul(left, right, precision=self.precision)


def _bias(conv: nnx.Conv) -> Array:
    assert conv.bias is not None  # Flax's own type allows for it
    return conv.bias[...][None]


def _rows_at(rows: Array, places: Array) -> Array:
    return rows.at[places].get(mode="promise_in_bounds")
