"""Samples of four matches, as RANSAC wants them: uniform, never degenerate, the same in any batch and any padding."""

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.types import Array

ROUND = 256  # samples of a round, at most
_DRAWN = 6 * ROUND  # for which so many are drawn: random points keep their orientations in a fifth of all draws
_TRIANGLES = (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)
_FLAT = 1e-6  # of a triangle's sides, its area's share that rounding makes
_BLOCK = 64  # of the running count below
_TRIANGLE = np.tri(_BLOCK, dtype=np.float32).T


def canonical_order(points: Array, real: Array) -> Array:
    """`[K]` slots of the real matches by a hash of what they are, then the others: no order that anybody gave them.

    Args:
        points: `[K, 4]` coordinates in both images.
        real: `[K]` bool.
    """
    bits = jax.lax.bitcast_convert_type(points.astype(jnp.float32) + 0.0, jnp.uint32)  # 0 and -0 are equal
    code = jnp.zeros(real.shape, jnp.uint32)
    for column in range(4):
        code = _mixed(code ^ bits[:, column])
    keys = ~real, code, *bits.T  # the coordinates themselves where two codes are one
    return jax.lax.sort((*keys, jnp.arange(len(real), dtype=jnp.int32)), num_keys=len(keys))[-1]


def draw(key: Array, round_number: Array, count: Array) -> Array:
    """`[4, S]` int32: four distinct numbers below `count`, which is at least 4, each set of them as likely."""
    bits = jax.random.bits(jax.random.fold_in(key, round_number), (4, _DRAWN), jnp.uint32)
    share = (bits >> 8).astype(jnp.float32) * 2.0**-24
    left = count - jnp.arange(4, dtype=jnp.int32)  # numbers that are not taken, of which one is drawn
    place = jnp.minimum((share * left[:, None].astype(jnp.float32)).astype(jnp.int32), left[:, None] - 1)
    taken: list[Array] = []
    for number in place:
        for other in _ascending(taken):
            number = number + (number >= other).astype(jnp.int32)
        taken.append(number)
    return jnp.stack(taken)


def accepted(points: Array, key: Array, round_number: Array, count: Array) -> tuple[Array, Array]:
    """`[4, 4, R]` (x1, y1, x0, y0) of four matches each, in the order drawn; and how many of the R are samples.

    Refused is, as in OpenCV's findHomography, what no camera can see: four points of which three lie on a line in one
    image, or whose triangles do not all keep or all change their orientation.

    Args:
        points: `[K, 4]` coordinates, the real matches first.
        key: of all rounds.
        round_number: counts rounds.
        count: real matches, at least 4.
    """
    index = jax.lax.optimization_barrier(draw(key, round_number, count))  # or each coordinate draws again
    number = _running_count(~_refused(_of(points, index)))
    chosen = jnp.searchsorted(number, jnp.arange(1, ROUND + 1, dtype=number.dtype), method="scan_unrolled")
    index = index.at[:, jnp.minimum(chosen, _DRAWN - 1)].get(mode="promise_in_bounds")
    return _of(points, index), jnp.minimum(number[-1].astype(jnp.int32), ROUND)


def areas(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Twice the signed areas of the `_TRIANGLES` of four points `[4, ...]`."""
    x, y = x - x[:1], y - y[:1]
    a012, a013, a023 = (x[i] * y[j] - x[j] * y[i] for i, j in ((1, 2), (1, 3), (2, 3)))
    return a012, a013, a023, a023 + a012 - a013


def _of(points: Array, index: Array) -> Array:
    """`[4, 4, S]` the four columns of the matches `[4, S]`."""
    return jnp.moveaxis(points.at[index].get(mode="promise_in_bounds"), 2, 0)


def _refused(samples: Array) -> Array:
    """`[S]` whether samples turn a triangle over, or have a flat one, up to the rounding of their coordinates."""
    x1, y1, x0, y0 = samples
    kept, flat = [], []
    for area1, area0, (corner, *others) in zip(areas(x1, y1), areas(x0, y0), _TRIANGLES, strict=True):
        kept.append(area1 * area0 > 0)
        for area, x, y in ((area1, x1, y1), (area0, x0, y0)):
            sides = sum(jnp.abs(values[other] - values[corner]) for values in (x, y) for other in others)
            flat.append(jnp.abs(area) <= _FLAT * sides)
    number = jnp.sum(jnp.stack(kept), axis=0)
    return ((number != 0) & (number != len(kept))) | jnp.any(jnp.stack(flat), axis=0)


def _running_count(chosen: Array) -> Array:
    """`[S]` float32 how many are chosen up to each, itself among them: two small products, faster than a scan."""
    within = jnp.matmul(chosen.astype(jnp.float32).reshape(-1, _BLOCK), _TRIANGLE)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)


def _ascending(values: list[Array]) -> list[Array]:
    """Up to three arrays, sorted element by element."""
    if len(values) < 2:
        return values
    low, high = jnp.minimum(*values[:2]), jnp.maximum(*values[:2])
    if len(values) == 2:
        return [low, high]
    lowest, highest = jnp.minimum(low, values[2]), jnp.maximum(high, values[2])
    return [lowest, low + high + values[2] - lowest - highest, highest]


def _mixed(code: Array) -> Array:
    """A permutation of 32-bit numbers without visible order (Wellons' lowbias32)."""
    code = (code ^ (code >> 16)) * jnp.uint32(0x7FEB352D)
    code = (code ^ (code >> 15)) * jnp.uint32(0x846CA68B)
    return code ^ (code >> 16)
