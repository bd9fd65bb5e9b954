"""Samples of four matches for RANSAC: uniform, never degenerate, independent of batch and padding."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.types import Array

ROUND = 256  # maximum number of samples of a round
_DRAWS = 6 * ROUND  # draws for a round: a fifth of all draws of random points keep their orientations
_TRIANGLES = (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)
_FLAT = 1e-6  # area of a triangle, relative to its sides, that rounding can produce
_BLOCK = 64  # of `_running_count`
_TRIANGLE = np.tri(_BLOCK, dtype=np.float32).T


def canonical_order(points: Float[Array, "slots 4"], real: Bool[Array, " slots"]) -> Int[Array, " slots"]:
    """Slots of the real matches, sorted by a hash of their coordinates whatever their order, then padding."""
    bits = jax.lax.bitcast_convert_type(points.astype(jnp.float32) + 0.0, jnp.uint32)  # 0 and -0 are equal
    code = jnp.zeros(real.shape, jnp.uint32)
    for column in range(4):
        code = _mix(code ^ bits[:, column])
    keys = ~real, code, *bits.T  # the coordinates decide if two codes are equal
    return jax.lax.sort((*keys, jnp.arange(len(real), dtype=jnp.int32)), num_keys=len(keys))[-1]


def draw_four(key: Array, round_number: Int[Array, ""] | int, count: Int[Array, ""] | int) -> Int[Array, "4 draws"]:
    """Four distinct numbers below `count` (at least 4), all sets equally likely."""
    bits = jax.random.bits(jax.random.fold_in(key, round_number), (4, _DRAWS), jnp.uint32)
    share = (bits >> 8).astype(jnp.float32) * 2.0**-24
    remaining = count - jnp.arange(4, dtype=jnp.int32)  # numbers that are not taken yet
    place = jnp.minimum((share * remaining[:, None].astype(jnp.float32)).astype(jnp.int32), remaining[:, None] - 1)
    taken: list[Array] = []
    for number in place:
        for other in _ascending(taken):
            number = number + (number >= other).astype(jnp.int32)
        taken.append(number)
    return jnp.stack(taken)


def draw_samples(
    points: Float[Array, "slots 4"], key: Array, round_number: Array, count: Array
) -> tuple[Float[Array, "coordinates=4 matches=4 samples"], Int[Array, ""]]:
    """Draw samples: (x1, y1, x0, y0) of four matches each, and their number.

    Only so many of the entries are samples. As in OpenCV's findHomography, a draw is rejected if no camera can see
    it: three of the points lie on a line in one image, or some but not all triangles change their orientation. The
    first `count` of the points, at least 4, are real matches.
    """
    index = jax.lax.optimization_barrier(draw_four(key, round_number, count))  # each coordinate would draw again
    number = _running_count(~_is_degenerate(_gather(points, index)))
    draws = jnp.searchsorted(number, jnp.arange(1, ROUND + 1, dtype=number.dtype), method="scan_unrolled")
    index = index.at[:, jnp.minimum(draws, _DRAWS - 1)].get(mode="promise_in_bounds")
    return _gather(points, index), jnp.minimum(number[-1].astype(jnp.int32), ROUND)


def areas(x: Float[Array, "4 ..."], y: Float[Array, "4 ..."]) -> tuple[Array, Array, Array, Array]:
    """Twice the signed areas of the `_TRIANGLES` of four points."""
    x, y = x - x[:1], y - y[:1]
    a012, a013, a023 = (x[i] * y[j] - x[j] * y[i] for i, j in ((1, 2), (1, 3), (2, 3)))
    return a012, a013, a023, a023 + a012 - a013


def _gather(
    points: Float[Array, "slots coordinates=4"], index: Int[Array, "matches=4 samples"]
) -> Float[Array, "coordinates=4 matches=4 samples"]:
    """Coordinates (x1, y1, x0, y0) of the matches `index`."""
    return jnp.moveaxis(points.at[index].get(mode="promise_in_bounds"), 2, 0)


def _is_degenerate(samples: Float[Array, "coordinates=4 matches=4 samples"]) -> Bool[Array, " samples"]:
    """Some but not all triangles change their orientation, or a triangle is flat."""
    x1, y1, x0, y0 = samples
    same_orientation, flat = [], []
    for area1, area0, (corner, *ends) in zip(areas(x1, y1), areas(x0, y0), _TRIANGLES, strict=True):
        same_orientation.append(area1 * area0 > 0)
        for area, x, y in ((area1, x1, y1), (area0, x0, y0)):
            sides = sum(jnp.abs(values[end] - values[corner]) for values in (x, y) for end in ends)
            flat.append(jnp.abs(area) <= _FLAT * sides)
    number = jnp.sum(jnp.stack(same_orientation), axis=0)
    return ((number != 0) & (number != len(same_orientation))) | jnp.any(jnp.stack(flat), axis=0)


def _running_count(hits: Bool[Array, " samples"]) -> Float[Array, " samples"]:
    """Cumulative sum of booleans; a matrix product is faster than a scan."""
    within = jnp.matmul(hits.astype(jnp.float32).reshape(-1, _BLOCK), _TRIANGLE)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)


def _ascending(values: list[Array]) -> list[Array]:
    """Sort up to three arrays element by element."""
    if len(values) < 2:
        return values
    low, high = jnp.minimum(*values[:2]), jnp.maximum(*values[:2])
    if len(values) == 2:
        return [low, high]
    lowest, highest = jnp.minimum(low, values[2]), jnp.maximum(high, values[2])
    return [lowest, low + high + values[2] - lowest - highest, highest]


def _mix(code: Array) -> Array:
    """Hash of 32-bit numbers that maps no two to the same (Wellons' lowbias32)."""
    code = (code ^ (code >> 16)) * jnp.uint32(0x7FEB352D)
    code = (code ^ (code >> 15)) * jnp.uint32(0x846CA68B)
    return code ^ (code >> 16)
