"""ALIKED's detector: peaks of a score map, refined to fractions of a pixel. For one image; `vmap` is the caller's."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mfvpr.networks.sampling import sample

RADIUS = 2  # px: of the suppression, of the refinement, and of the border, which has no keypoints
_TEMPERATURE = 0.1


class Detections(NamedTuple):
    """Keypoints of one image in N slots: row by row, or by falling score where there are more than slots."""

    keypoints: Array  # [N, 2] (x, y) px
    scores: Array  # [N]
    mask: Array  # [N] bool, True on the first ones
    count: Array  # [] how many were found; where it exceeds N, those of the lowest scores are missing


def detect(score_map: Array, threshold: Array | float, capacity: int) -> Detections:
    """Peaks of a map `[H, W]` above `threshold`; above the map's mean where none is, or where `threshold` is 0.

    There are min(capacity, H W) slots. (The original takes the mean where none is in the whole batch.)
    """
    width = score_map.shape[1]
    scores, peaks = score_map.reshape(-1), _peaks(score_map).reshape(-1)
    above = peaks & (scores > threshold) & (threshold > 0)
    valid = jnp.where(jnp.any(above), above, peaks & (scores > jnp.mean(scores)))
    count = jnp.sum(valid)
    capacity = min(capacity, valid.size)
    in_order = -jnp.arange(valid.size, dtype=scores.dtype)
    key, place = jax.lax.top_k(jnp.where(valid, jnp.where(count > capacity, scores, in_order), -jnp.inf), capacity)
    keypoints = _refined(score_map, place // width, place % width)
    return Detections(keypoints, sample(score_map[..., None], keypoints)[..., 0], key > -jnp.inf, count)


def _peaks(scores: Array) -> Array:
    """`[H, W]` bool: maxima of their neighborhoods, and twice more those of what maxima left standing; no border."""
    found = scores == _spread(scores)
    for _ in range(2):
        suppressed = _spread(found)
        others = jnp.where(suppressed, 0, scores)
        found |= (others == _spread(others)) & ~suppressed
    inside = [(jnp.arange(size) >= RADIUS) & (jnp.arange(size) < size - RADIUS) for size in scores.shape]
    return found & inside[0][:, None] & inside[1][None, :]


def _spread(values: Array) -> Array:
    """The maximum around each pixel, of columns and then of rows: slices, which are faster than a window reduction."""
    lowest = False if values.dtype == bool else -jnp.inf
    for axis, size in enumerate(values.shape):
        margin = [(0, 0), (0, 0)]
        margin[axis] = (RADIUS, RADIUS)
        padded = jnp.pad(values, margin, constant_values=lowest)
        for shift in range(2 * RADIUS + 1):
            values = jnp.maximum(values, jax.lax.slice_in_dim(padded, shift, shift + size, axis=axis))
    return values


def _refined(score_map: Array, row: Array, column: Array) -> Array:
    """`[N, 2]` (x, y) px: the mean position around each peak, weighted by a softmax of the scores."""
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
    """Through [-1, 1], as the original goes, to the last bit.

    Whole numbers may come out a little smaller, and the descriptor truncates. XLA would multiply by the reciprocal of a
    number that all positions share, which rounds otherwise, so each has its own: `total` is 1 or more, which XLA does
    not know.
    """
    last = jnp.where(total > 0, jnp.asarray(size - 1, position.dtype), 1)
    return ((position / last * 2 - 1) / 2 + 0.5) * last
