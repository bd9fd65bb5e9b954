"""Homographies of matched points: samples of four matches, models through them, errors, least squares.

A model is a matrix, row by row, that maps points of the candidate (1) to points of the query (0). Matches are the
coordinates x1, y1, x0, y0. Samples are uniform, never degenerate, and independent of batch and padding.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Num

from mfvpr.core.types import Array

ROUND = 256  # maximum number of samples of a round
_DRAWS = 6 * ROUND  # draws for a round: a fifth of all draws of random points keep their orientations
_TRIANGLES = (0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)
_FLAT = 1e-6  # area of a triangle, relative to its sides, that rounding can produce
_STEPS = 10  # of the least squares, as in OpenCV
_MIN_CURVATURE = 1e-9  # keeps the system solvable if the inliers do not determine a parameter
_EXACT = jax.lax.Precision.HIGHEST


def canonical_order(points: Float[Array, "slots 4"], real: Bool[Array, " slots"]) -> Int[Array, " slots"]:
    """Slots of the real matches, sorted by a hash of their coordinates whatever their order, then padding."""
    bits = jax.lax.bitcast_convert_type(points.astype(jnp.float32) + 0.0, jnp.uint32)  # 0 and -0 are equal
    code = jnp.zeros(real.shape, jnp.uint32)
    for column in range(4):  # Wellons' lowbias32, which maps no two numbers to the same
        code = code ^ bits[:, column]
        code = (code ^ (code >> 16)) * jnp.uint32(0x7FEB352D)
        code = (code ^ (code >> 15)) * jnp.uint32(0x846CA68B)
        code = code ^ (code >> 16)
    keys = ~real, code, *bits.T  # the coordinates decide if two codes are equal
    return jax.lax.sort((*keys, jnp.arange(len(real), dtype=jnp.int32)), num_keys=len(keys))[-1]


def draw_four(key: Array, round_number: Int[Array, ""] | int, count: Int[Array, ""] | int) -> Int[Array, "4 draws"]:
    """Four distinct numbers below `count` (at least 4), all sets equally likely."""
    bits = jax.random.bits(jax.random.fold_in(key, round_number), (4, _DRAWS), jnp.uint32)
    share = (bits >> 8).astype(jnp.float32) * 2.0**-24
    remaining = count - jnp.arange(4, dtype=jnp.int32)  # numbers that are not taken yet
    place = jnp.minimum((share * remaining[:, None].astype(jnp.float32)).astype(jnp.int32), remaining[:, None] - 1)
    numbers: list[Array] = []
    taken: list[Array] = []  # the same numbers, ascending
    for number in place:
        for other in taken:
            number = number + (number >= other).astype(jnp.int32)
        numbers.append(number)
        for index, other in enumerate(taken):  # insert the number; what is larger moves on
            taken[index], number = jnp.minimum(other, number), jnp.maximum(other, number)
        taken.append(number)
    return jnp.stack(numbers)


def draw_samples(
    points: Float[Array, "slots 4"], key: Array, round_number: Array, count: Array
) -> tuple[Float[Array, "coordinates=4 matches=4 samples"], Int[Array, ""]]:
    """Draw samples: (x1, y1, x0, y0) of four of the first `count` matches each, and the number of samples.

    As in OpenCV's findHomography, a draw is rejected if no camera can see it: three of the points lie on a line in one
    image, or some but not all triangles change their orientation.
    """
    index = jax.lax.optimization_barrier(draw_four(key, round_number, count))  # each coordinate would draw again
    number = jnp.cumsum(~_is_degenerate(_gather(points, index)), dtype=jnp.int32)
    draws = jnp.searchsorted(number, jnp.arange(1, ROUND + 1, dtype=jnp.int32), method="scan_unrolled")
    index = index.at[:, jnp.minimum(draws, _DRAWS - 1)].get(mode="promise_in_bounds")
    return _gather(points, index), jnp.minimum(number[-1], ROUND)


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


class Frame(NamedTuple):
    """Coordinates in which the points of an image lie within -1 and 1, where single precision is enough.

    The frame follows from the image sizes: one far point would cost the other points their digits.
    """

    center: Float[Array, "4"]  # px
    scale: Float[Array, "2"]  # px

    @classmethod
    def of(cls, size1: Num[Array, "2"], size0: Num[Array, "2"], dtype: Any) -> "Frame":
        """Frame of images with sizes in px; an invalid size leaves coordinates as they are."""
        sizes = jnp.stack([jnp.asarray(size, dtype) for size in (size1, size0)])
        half = jnp.where(jnp.isfinite(sizes) & (sizes > 0), sizes, 0.0) / 2
        scale = jnp.max(half, axis=1)
        return cls(half.reshape(4), jnp.where(scale > 0, scale, 1.0))

    def normalize(self, points: Float[Array, "slots 4"]) -> Float[Array, "slots 4"]:
        """Points in px, in the coordinates of the frame."""
        return (points - self.center[None]) / jnp.repeat(self.scale, 2)[None]

    def to_pixels(self, model: Float[Array, "9"]) -> Float[Array, "3 3"]:
        """Matrix in px, last entry 1, of a model in the coordinates of the frame."""
        (x1, y1, x0, y0), (scale1, scale0) = self.center, self.scale
        zero, unit = jnp.zeros_like(x1), jnp.ones_like(x1)
        enter = jnp.stack([unit, zero, -x1, zero, unit, -y1, zero, zero, scale1]).reshape(3, 3)
        leave = jnp.stack([scale0, zero, x0, zero, scale0, y0, zero, zero, unit]).reshape(3, 3)
        matrix = jnp.matmul(jnp.matmul(leave, model.reshape(3, 3), precision=_EXACT), enter, precision=_EXACT)
        return matrix / matrix[2, 2]


def through(four: Float[Array, "coordinates=4 matches=4 samples"]) -> Float[Array, "9 samples"]:
    """Homographies through four matches (x1, y1, x0, y0).

    No three points may lie on a line. The fourth point of the candidate is p_3 = sum_i l_i p_i, where the l_i are
    ratios of triangles; in the query, q_3 = sum_i m_i q_i. A map from p_i to (m_i / l_i) q_i for i < 3 also maps p_3 to
    q_3. Hence H = sum_i (m_i / l_i) q_i r_i^T, where the r_i are the rows of the inverse of (p_0 p_1 p_2): the lines
    through two of these points. H is multiplied by l_0 l_1 l_2, so that it needs no division.
    """
    x1, y1, x0, y0 = four
    (l0, l1, l2), (m0, m1, m2) = _shares(x1, y1), _shares(x0, y0)
    scales = m0 * l1 * l2, m1 * l0 * l2, m2 * l0 * l1
    x, y, u, v = (values - values[:1] for values in four)  # the first point is the origin of both images
    scales, x, y, u, v = jax.lax.optimization_barrier((scales, x, y, u, v))  # each entry would recompute them
    lines = (y[1] - y[2], x[2] - x[1], x[1] * y[2] - x[2] * y[1]), (y[2], -x[2]), (-y[1], x[1])
    top, middle = (
        [scales[1] * side[1] * lines[1][column] + scales[2] * side[2] * lines[2][column] for column in (0, 1)]
        for side in (u, v)
    )
    bottom = [sum(scale * line[column] for scale, line in zip(scales, lines, strict=True)) for column in (0, 1)]
    last = scales[0] * lines[0][2]
    # From coordinates relative to the first point back to those of the frame.
    last = last - bottom[0] * x1[0] - bottom[1] * y1[0]
    bottom = [*bottom, last]
    rows = [[*side, -side[0] * x1[0] - side[1] * y1[0]] for side in (top, middle)]
    model = [
        value + origin * base
        for row, origin in zip(rows, (x0[0], y0[0]), strict=True)
        for value, base in zip(row, bottom, strict=True)
    ]
    size = jnp.abs(bottom[0]) + jnp.abs(bottom[1]) + jnp.abs(bottom[2])
    return jnp.stack([*model, *bottom]) / size[None]  # NaN if all entries are 0: a model of zeros would have no errors


def _shares(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """l_0, l_1, l_2 of the fourth point, up to a common factor that avoids underflow."""
    _, a013, a023, a123 = areas(x, y)
    size = jnp.abs(a013) + jnp.abs(a023) + jnp.abs(a123)
    return a123 / size, -a023 / size, a013 / size


def is_inlier(model: Array, points: Array, threshold: Array) -> Array:
    """Whether the distance of H p1 from p0 is at most the threshold.

    Either models `[9, ...]` and one match `[4]`, or one model and matches `[K, 4]`.
    """
    x1, y1, x0, y0 = jnp.moveaxis(points, -1, 0)
    u, v, w = (model[row] * x1 + model[row + 1] * y1 + model[row + 2] for row in (0, 3, 6))
    u, v, limit = u - x0 * w, v - y0 * w, threshold * w  # both sides times the last coordinate of H p1
    return u * u + v * v <= limit * limit


def least_squares(
    model: Float[Array, "9"], points: Float[Array, "slots 4"], weights: Float[Array, " slots"]
) -> Float[Array, "9"]:
    """Model with the least weighted squared error for matches."""
    x1, y1, x0, y0 = points.T
    plane, roots = jnp.stack([x1, y1, jnp.ones_like(x1)]), jnp.sqrt(weights)
    target = jnp.stack([x0, y0])

    def errors_of(free: Float[Array, "8"]) -> tuple[Float[Array, "2 slots"], Float[Array, " slots"]]:
        """Weighted errors, and the common factor of their derivatives."""
        u, v, w = jnp.matmul(jnp.append(free, 1.0).reshape(3, 3), plane, precision=_EXACT)
        inverse = roots / w
        return jnp.stack([u, v]) * inverse[None] - target * roots[None], inverse

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        free, damping = state
        errors, inverse = errors_of(free)
        lines = plane * inverse[None]  # [3, K]
        outer = -(errors + target * roots[None])[:, None] * (lines[:2] / jnp.where(roots > 0, roots, 1.0)[None])[None]
        zeros = jnp.zeros_like(lines)
        slopes = jnp.stack([jnp.concatenate(rows) for rows in ((lines, zeros, outer[0]), (zeros, lines, outer[1]))])
        slopes = jnp.moveaxis(slopes, 1, 0).reshape(8, -1)
        square = jnp.matmul(slopes, slopes.T, precision=_EXACT)
        square = square + jnp.diag(damping * jnp.diag(square) + _MIN_CURVATURE)
        change = jnp.linalg.solve(square, jnp.matmul(slopes, errors.reshape(-1), precision=_EXACT))
        is_better = jnp.sum(errors_of(free - change)[0] ** 2) < jnp.sum(errors**2)
        return jnp.where(is_better, free - change, free), damping * jnp.where(is_better, 0.1, 10.0)

    start = model[:8] / model[8], jnp.asarray(1e-3, model.dtype)
    return jnp.append(jax.lax.fori_loop(0, _STEPS, step, start)[0], 1.0)
