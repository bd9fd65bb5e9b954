"""Homographies of matched points: frames, models through four matches, what they miss, and least squares.

A model is `[9]`, a matrix row by row that maps points of the candidate (1) to those of the query (0). Matches are
`[K, 4]` coordinates x1, y1, x0, y0.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mfvpr.scoring.quads import areas
from mfvpr.types import Array

_STEPS = 10  # of the least squares, as OpenCV's
_LEAST = 1e-9  # curvature, where the inliers leave a parameter open
_EXACT = jax.lax.Precision.HIGHEST


class Frame(NamedTuple):
    """Coordinates in which the points of an image are from -1 to 1: single precision is enough there.

    Of the images' sizes, not of the points: one far outside would cost the others their digits.

    center: `[4]`, px; scale: `[2]`, px.
    """

    center: Array
    scale: Array

    @classmethod
    def of(cls, size1: Array, size0: Array) -> "Frame":
        """Of both images' sizes `[2]`, px; what is no size moves and scales nothing."""
        sizes = jnp.stack([size1, size0])
        half = jnp.where(jnp.isfinite(sizes) & (sizes > 0), sizes, 0.0) / 2
        scale = jnp.max(half, axis=1)
        return cls(half.reshape(4), jnp.where(scale > 0, scale, 1.0))

    def inside(self, points: Array) -> Array:
        """`[K, 4]` px in these coordinates."""
        return (points - self.center[None]) / jnp.repeat(self.scale, 2)[None]

    def outside(self, model: Array) -> Array:
        """`[3, 3]` of a model `[9]` in these coordinates: that in px, with 1 as its last number."""
        (x1, y1, x0, y0), (scale1, scale0) = self.center, self.scale
        zero, one = jnp.zeros_like(x1), jnp.ones_like(x1)
        enter = jnp.stack([one, zero, -x1, zero, one, -y1, zero, zero, scale1]).reshape(3, 3)
        leave = jnp.stack([scale0, zero, x0, zero, scale0, y0, zero, zero, one]).reshape(3, 3)
        matrix = jnp.matmul(jnp.matmul(leave, model.reshape(3, 3), precision=_EXACT), enter, precision=_EXACT)
        return matrix / matrix[2, 2]


def through(four: Array) -> Array:
    """`[9, S]` homographies through four matches `[4, 4, S]` (x1, y1, x0, y0) of which no three lie on a line.

    The fourth point is p3 = sum l_i p_i of the others, l_i a ratio of triangles; likewise in the other image, with m_i.
    What takes p_i to (m_i / l_i) q_i takes p3 to q3: H = sum (m_i / l_i) q_i r_i^T, with rows r_i of the inverse of
    (p_0 p_1 p_2), which are the lines through two of its points. Times l_0 l_1 l_2, it needs no division.
    """
    x1, y1, x0, y0 = four
    (l0, l1, l2), (m0, m1, m2) = _shares(x1, y1), _shares(x0, y0)
    scales = m0 * l1 * l2, m1 * l0 * l2, m2 * l0 * l1
    x, y, u, v = (values - values[:1] for values in four)  # the first point is the origin of both images
    scales, x, y, u, v = jax.lax.optimization_barrier((scales, x, y, u, v))  # or each number computes them again
    lines = (y[1] - y[2], x[2] - x[1], x[1] * y[2] - x[2] * y[1]), (y[2], -x[2]), (-y[1], x[1])
    top, middle = (
        [scales[1] * side[1] * lines[1][column] + scales[2] * side[2] * lines[2][column] for column in (0, 1)]
        for side in (u, v)
    )
    bottom = [sum(scale * line[column] for scale, line in zip(scales, lines, strict=True)) for column in (0, 1)]
    last = scales[0] * lines[0][2]
    # From the first point's coordinates to the frame's.
    last = last - bottom[0] * x1[0] - bottom[1] * y1[0]
    bottom = [*bottom, last]
    rows = [[*side, -side[0] * x1[0] - side[1] * y1[0]] for side in (top, middle)]
    model = [
        value + origin * base
        for row, origin in zip(rows, (x0[0], y0[0]), strict=True)
        for value, base in zip(row, bottom, strict=True)
    ]
    size = jnp.abs(bottom[0]) + jnp.abs(bottom[1]) + jnp.abs(bottom[2])
    return jnp.stack([*model, *bottom]) / size[None]  # NaN where rounding left nothing: 0 would miss nothing


def _shares(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """l_0, l_1, l_2 of the fourth point, in a unit in which they may be multiplied: areas may be too small."""
    _, a013, a023, a123 = areas(x, y)
    size = jnp.abs(a013) + jnp.abs(a023) + jnp.abs(a123)
    return a123 / size, -a023 / size, a013 / size


def miss(model: Array, points: Array, threshold: Array) -> tuple[Array, Array]:
    """Squared distance of H p1 from p0, and the squared threshold, both times (the last coordinate of H p1)^2.

    Without a division. Of models `[9, ...]` and a point `[4]`, or of one model and points `[K, 4]`.
    """
    x1, y1, x0, y0 = jnp.moveaxis(points, -1, 0)
    u, v, w = (model[row] * x1 + model[row + 1] * y1 + model[row + 2] for row in (0, 3, 6))
    u, v, limit = u - x0 * w, v - y0 * w, threshold * w
    return u * u + v * v, limit * limit


def is_inlier(model: Array, points: Array, threshold: Array) -> Array:
    """As `miss`: whether the distance is at most the threshold; of NaN it is not."""
    error, limit = miss(model, points, threshold)
    return error <= limit


def least_squares(model: Array, points: Array, weights: Array) -> Array:
    """The model `[9]` that lets points `[K, 4]` miss least, in squares with weights `[K]`, by Levenberg-Marquardt."""
    x1, y1, x0, y0 = points.T
    plane, roots = jnp.stack([x1, y1, jnp.ones_like(x1)]), jnp.sqrt(weights)
    target = jnp.stack([x0, y0])

    def misses(free: Array) -> tuple[Array, Array]:
        """Errors `[2, K]`, and what is the same in all their derivatives `[2, K]`."""
        u, v, w = jnp.matmul(jnp.append(free, 1.0).reshape(3, 3), plane, precision=_EXACT)
        inverse = roots / w
        return jnp.stack([u, v]) * inverse[None] - target * roots[None], inverse

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        free, damping = state
        errors, inverse = misses(free)
        lines = plane * inverse[None]  # [3, K]
        outer = -(errors + target * roots[None])[:, None] * (lines[:2] / jnp.where(roots > 0, roots, 1.0)[None])[None]
        none = jnp.zeros_like(lines)
        slopes = jnp.stack([jnp.concatenate(rows) for rows in ((lines, none, outer[0]), (none, lines, outer[1]))])
        slopes = jnp.moveaxis(slopes, 1, 0).reshape(8, -1)
        square = jnp.matmul(slopes, slopes.T, precision=_EXACT)
        square = square + jnp.diag(damping * jnp.diag(square) + _LEAST)
        change = jnp.linalg.solve(square, jnp.matmul(slopes, errors.reshape(-1), precision=_EXACT))
        less = jnp.sum(misses(free - change)[0] ** 2) < jnp.sum(errors**2)
        return jnp.where(less, free - change, free), damping * jnp.where(less, 0.1, 10.0)

    start = model[:8] / model[8], jnp.asarray(1e-3, model.dtype)
    return jnp.append(jax.lax.fori_loop(0, _STEPS, step, start)[0], 1.0)
