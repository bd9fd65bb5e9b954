"""Bins of a histogram of shifts, votes for them, and the peak between bins. Lengths are pixels."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.core.types import Array
from mfvpr.utils.numerics import masked, safe_sqrt

_NEAR = 32.0  # temperatures; e^32 is far from overflow
_MOST_STEPS = 100  # hardly any pair needs 10
_TOLERANCE = 1e-4  # standard deviations


class Lattice(NamedTuple):
    """Positions of the bins, and the width of the votes, px."""

    first: Float[Array, "*batch 2"]  # center (x, y) of the first bin
    num_bins: Float[Array, "*batch 2"]
    bin_size: Float[Array, "*batch"]
    deviation: Float[Array, "*batch"]  # sigma of equation 1
    truncate: Float[Array, "*batch"]  # sigmas

    def centers(self, axis: int, index: Array) -> Array:
        """Centers of bins along an axis, px, by bin number."""
        return self.first[axis] + index * self.bin_size

    def inside(self, capacity: int) -> Bool[Array, "bins bins"]:
        """(y, x), True for bins within the range of shifts."""
        index = jnp.arange(capacity, dtype=self.num_bins.dtype)
        return (index < self.num_bins[1])[:, None] & (index < self.num_bins[0])[None]

    def usable(self, capacity: int) -> Bool[Array, ""]:
        """Whether the bins fit the capacity, and `deviation` and `truncate` are numbers."""
        # Checked here, because XLA's maximum over thousands of values on a CPU skips NaN.
        fits = jnp.all((self.num_bins >= 1) & (self.num_bins <= capacity))
        return fits & ~jnp.isnan(self.deviation) & ~jnp.isnan(self.truncate)


def gaussian(distance: Array, deviation: Array, truncate: Array) -> Array:
    """Votes exp(-d^2 / (2 sigma^2)) of matches at a distance d along one axis."""
    sigmas = distance / deviation
    return jnp.where(jnp.abs(sigmas) > truncate, 0.0, jnp.exp(-0.5 * sigmas**2))


def votes(
    shifts: Float[Array, "2 slots"], lattice: Lattice, capacity: int
) -> tuple[Float[Array, "bins slots"], Float[Array, "bins slots"]]:
    """Unweighted votes of shifts along x and along y."""
    index = jnp.arange(capacity, dtype=shifts.dtype)
    return votes_along(0, index, shifts, lattice), votes_along(1, index, shifts, lattice)


def votes_along(
    axis: int, index: Float[Array, "*bins"], shifts: Float[Array, "2 slots"], lattice: Lattice
) -> Float[Array, "*bins slots"]:
    """Votes of shifts along one axis, by bin number."""
    index = jnp.minimum(index, lattice.num_bins[axis] - 1)  # repeats the last bin, which changes no maximum
    # Bins along rows: the exponentials then run along K, which is longer and contiguous (1.8x faster).
    distance = lattice.centers(axis, index)[..., None] - shifts[axis][(None,) * index.ndim]
    return gaussian(distance, lattice.deviation, lattice.truncate)


def bin_scores(
    votes_x: Float[Array, "bins slots"], votes_y: Float[Array, "bins slots"], weights: Float[Array, " slots"]
) -> Float[Array, "bins bins"]:
    """(y, x) s_ij of equation 1: weighted sums of the votes."""
    return jnp.matmul(votes_y * weights[None], votes_x.T, precision=jax.lax.Precision.HIGHEST)


def tallest(scores: Float[Array, "*bins"], _: Bool[Array, "*bins"]) -> Float[Array, ""]:
    """Score of the tallest bin."""
    return jnp.max(scores)  # the mask would cost as much as the product; bins beyond the last only repeat it


def smooth_tallest(
    values: Float[Array, "*bins"], mask: Bool[Array, "*bins"], *, temperature: Array
) -> Float[Array, ""]:
    """T log(mean of e^(v / T)) of the values where `mask`."""
    # Relative to the maximum nothing overflows. The maximum drops out, so that its gradient would be 0.
    largest = jax.lax.stop_gradient(jnp.max(values))
    below = (masked(values, mask, largest) - largest) / temperature
    far = largest + temperature * jnp.log(jnp.mean(jnp.exp(below), where=mask))
    # Where the sum of both terms would cancel: small values, or one peak in many bins.
    is_near = (largest <= _NEAR * temperature) & (jnp.min(values) >= -temperature)
    ratios = masked(values / temperature, mask & is_near)
    return jnp.where(is_near, temperature * jnp.log1p(jnp.mean(jnp.expm1(ratios), where=mask)), far)


def pool_bins(
    shifts: Float[Array, "2 slots"],
    weights: Float[Array, "weightings slots"],
    lattice: Lattice,
    capacity: int,
    pool: Callable[[Array, Array], Array] = tallest,
) -> Float[Array, " weightings"]:
    """Scores of one pair by `pool(scores, inside)` of its bins `[B, B]`, for each weighting of its matches."""
    votes_x, votes_y = votes(shifts, lattice, capacity)
    inside = lattice.inside(capacity)

    def score(weights: Array) -> Array:
        return pool(bin_scores(votes_x, votes_y, weights), inside)

    if len(weights) == 1:
        return score(weights[0])[None]
    # One after the other they stay in the cache of a CPU; an accelerator needs long operations.
    return jax.lax.platform_dependent(weights, cpu=partial(jax.lax.map, score), default=jax.vmap(score))


def climb(
    start: Float[Array, "2"],
    shifts: Float[Array, "slots 2"],
    weights: Float[Array, " slots"],
    deviation: Float[Array, ""],
) -> Float[Array, "2"]:
    """Maximum of sum_k w_k exp(-|s - s_k|^2 / (2 sigma^2)) uphill from s = `start`, to 1e-4 sigma.

    Each step is Newton's or that of mean shift, whichever ends higher. First and second derivatives are exact.
    """
    fixed = jax.lax.stop_gradient((shifts, weights, deviation))

    def higher(shift: Array, steps: Array) -> Array:
        ends = shift[None] + steps
        sums = [jnp.sum(_pull(end, *fixed)[1]) for end in ends]
        return jnp.where(sums[0] >= sums[1], ends[0], ends[1])

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, shift, steps = state
        length = jnp.sqrt(jnp.sum(steps[0] ** 2))
        newton = steps[0] * jnp.minimum(1.0, fixed[2] / length)
        shift = higher(shift, jnp.stack([newton, steps[1]]))
        return number + 1, shift, _steps(shift, *fixed)

    def is_climbing(state: tuple[Array, Array, Array]) -> Array:
        number, _, (newton, _) = state
        return (number < _MOST_STEPS) & (jnp.sqrt(jnp.sum(newton**2)) > _TOLERANCE * fixed[2])

    start = jax.lax.stop_gradient(start)
    _, shift, _ = jax.lax.while_loop(is_climbing, step, (jnp.zeros((), jnp.int32), start, _steps(start, *fixed)))
    for _ in range(2):  # each Newton step doubles the order up to which derivatives are correct
        shift = shift + _steps(shift, shifts, weights, deviation)[0]
    return shift


def _pull(shift: Array, shifts: Array, weights: Array, deviation: Array) -> tuple[Array, Array]:
    """Offsets of the matches from a shift, and their weighted votes for it."""
    offsets = shifts - shift[None]
    return offsets, weights * jnp.exp(-0.5 * jnp.sum((offsets / deviation) ** 2, axis=-1))


def _steps(shift: Array, shifts: Array, weights: Array, deviation: Array) -> Float[Array, "2 2"]:
    """Newton's step and the step of mean shift (Comaniciu & Meer, PAMI 2002), px; 0 without votes.

    Where the sum is not concave, a multiple of the identity in the Hessian makes Newton's step lead uphill.
    """
    offsets, pull = _pull(shift, shifts, weights, deviation)
    total = jnp.sum(pull)
    pull = jnp.where(total > 0, pull / jnp.where(total > 0, total, 1.0), 0.0)[:, None]
    mean, scaled = jnp.sum(pull * offsets, axis=0), offsets / deviation
    xx, yy = 1 - jnp.sum(pull * scaled**2, axis=0)
    xy = -jnp.sum(pull[:, 0] * scaled[:, 0] * scaled[:, 1])
    smallest = (xx + yy) / 2 - safe_sqrt(((xx - yy) / 2) ** 2 + xy**2)  # eigenvalue
    damping = 2 * jnp.maximum(-smallest, 0.0)
    xx, yy = xx + damping, yy + damping
    determinant = xx * yy - xy**2
    newton = jnp.stack([yy * mean[0] - xy * mean[1], xx * mean[1] - xy * mean[0]])
    newton = jnp.where(determinant > 0, newton / jnp.where(determinant > 0, determinant, 1.0), mean)
    return jnp.stack([newton, mean])
