"""ALIKED's detector: peaks of one image's score map, refined to fractions of a pixel."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array
from mfvpr.networks.sampling import sample

RADIUS = 2  # px, of the suppression, the refinement and the border without keypoints
_TEMPERATURE = 0.1


class Detections(NamedTuple):
    """Keypoints of one image, ordered by row, or by score if there are more than slots."""

    keypoints: Float[Array, "slots 2"]  # (x, y) px
    scores: Float[Array, " slots"]
    mask: Bool[Array, " slots"]  # True on the first ones
    count: Int[Array, ""]  # number of peaks; if above the slots, those with the lowest scores are missing


def detect(score_map: Float[Array, "height width"], threshold: Array | float, capacity: int) -> Detections:
    """Peaks of a map above `threshold`, in min(capacity, height * width) slots.

    If no peak is above it, or `threshold` is 0, the map's mean is the threshold. (The original takes the mean if the
    whole batch has no peak.)
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
    return Detections(keypoints, sample(score_map[..., None], keypoints)[..., 0], key > -jnp.inf, count)


def _peaks(scores: Float[Array, "height width"]) -> Bool[Array, "height width"]:
    """Local maxima, and in two more rounds those outside the neighborhoods of maxima; no border."""
    is_peak = scores == _local_maximum(scores)
    for _ in range(2):
        suppressed = _local_maximum(is_peak)
        remaining = jnp.where(suppressed, 0, scores)
        is_peak |= (remaining == _local_maximum(remaining)) & ~suppressed
    inside = [(jnp.arange(size) >= RADIUS) & (jnp.arange(size) < size - RADIUS) for size in scores.shape]
    return is_peak & inside[0][:, None] & inside[1][None, :]


def _local_maximum(values: Array) -> Array:
    """Maximum around each pixel. Slices along each axis are faster than a window reduction."""
    lowest = False if values.dtype == bool else -jnp.inf
    for axis, size in enumerate(values.shape):
        margin = [(0, 0), (0, 0)]
        margin[axis] = (RADIUS, RADIUS)
        padded = jnp.pad(values, margin, constant_values=lowest)
        for shift in range(2 * RADIUS + 1):
            values = jnp.maximum(values, jax.lax.slice_in_dim(padded, shift, shift + size, axis=axis))
    return values


def _refine(
    score_map: Float[Array, "height width"], row: Int[Array, " slots"], column: Int[Array, " slots"]
) -> Float[Array, "slots 2"]:
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
