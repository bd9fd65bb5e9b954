"""The bins of a histogram of shifts, the votes of matches for them, and the peak between bins. Lengths are pixels."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mfvpr.types import Array
from mfvpr.utils.numerics import masked, safe_sqrt

_MOST_STEPS = 100  # of which hardly any pair takes 10
_TOLERANCE = 1e-4  # standard deviations


class Lattice(NamedTuple):
    """Where the bins are, and how votes fall off.

    first, num_bins: `[2]` (x, y) center of the first bin, and how many there are.  bin_size, deviation, truncate: `[]`.
    """

    first: Array
    num_bins: Array
    bin_size: Array
    deviation: Array
    truncate: Array

    def centers(self, axis: int, index: Array) -> Array:
        """Of bins by their (whole) number along an axis."""
        return self.first[axis] + index * self.bin_size

    def real(self, axis: int, index: Array) -> Array:
        """Of a bin's number, the bin itself; beyond the last the last again, which no maximum notices."""
        return jnp.minimum(index, self.num_bins[axis] - 1)

    def inside(self, capacity: int) -> Array:
        """`[B, B]` (y, x) bool, the bins that there are."""
        index = jnp.arange(capacity, dtype=self.num_bins.dtype)
        return (index < self.num_bins[1])[:, None] & (index < self.num_bins[0])[None]

    def usable(self, capacity: int) -> Array:
        """`[]` bool, whether there is room for all bins, and a width and a reach of the votes."""
        # Told beforehand: XLA's maximum over thousands of values on a CPU passes over NaN.
        room = jnp.all((self.num_bins >= 1) & (self.num_bins <= capacity))
        return room & ~jnp.isnan(self.deviation) & ~jnp.isnan(self.truncate)


def gaussian(distance: Array, deviation: Array, truncate: Array) -> Array:
    """Votes of matches at a distance along one axis."""
    sigmas = distance / deviation
    return jnp.where(jnp.abs(sigmas) > truncate, 0.0, jnp.exp(-0.5 * sigmas**2))


def votes(shifts: Array, lattice: Lattice, capacity: int) -> tuple[Array, Array]:
    """Votes `[B, K]` of shifts `[2, K]` along x and along y, without weights; beyond the last bin as for the last."""
    index = jnp.arange(capacity, dtype=shifts.dtype)
    x, y = (votes_along(axis, index, shifts, lattice) for axis in (0, 1))
    return x, y


def votes_along(axis: int, index: Array, shifts: Array, lattice: Lattice) -> Array:
    """Votes `[..., K]` of shifts `[2, K]` along one axis for bins by their number `[...]`."""
    # Bins along rows: the exponentials then run along K, which is longer and contiguous (1.8x faster).
    distance = lattice.centers(axis, lattice.real(axis, index))[..., None] - shifts[axis][(None,) * index.ndim]
    return gaussian(distance, lattice.deviation, lattice.truncate)


def bins(votes_x: Array, votes_y: Array, weights: Array) -> Array:
    """`[B, B]` (y, x) sums of the weighted votes `[B, K]`."""
    return jnp.matmul(votes_y * weights[None], votes_x.T, precision=jax.lax.Precision.HIGHEST)


def tallest(scores: Array, _: Array) -> Array:
    """The largest of all bins."""
    return jnp.max(scores)  # without a mask, which would cost as much as the product and is not needed


def smooth_tallest(values: Array, mask: Array, *, temperature: Array) -> Array:
    """T log(mean of e^(v / T)) of the values where `mask`."""
    # Relative to the maximum nothing overflows or cancels; its own gradient would be 0, since it drops out.
    largest = jax.lax.stop_gradient(jnp.max(values))
    below = (masked(values, mask, largest) - largest) / temperature
    return largest + temperature * jnp.log(jnp.mean(jnp.exp(below), where=mask))


def of_all_bins(
    shifts: Array,
    weights: Array,
    lattice: Lattice,
    capacity: int,
    pool: Callable[[Array, Array], Array] = tallest,
) -> Array:
    """What `pool(scores, inside)` makes of all bins, `[W]`, by several weights `[W, K]` of one pair's matches.

    The Gaussians, which do not depend on the weights, are evaluated once.
    """
    votes_x, votes_y = votes(shifts, lattice, capacity)
    inside = lattice.inside(capacity)

    def one(weights: Array) -> Array:
        return pool(bins(votes_x, votes_y, weights), inside)

    return mapped(one, weights)


def mapped(function: Callable[[Array], Array], rows: Array) -> Array:
    """`function` of every row, one at a time; of an only one without a loop."""
    return function(rows[0])[None] if len(rows) == 1 else jax.lax.map(function, rows)


def climb(start: Array, shifts: Array, weights: Array, deviation: Array) -> Array:
    """The maximum `[2]` of sum_k w_k exp(-|s - s_k|^2 / (2 sigma^2)) uphill from `start`, to 1e-4 sigma.

    Each step is the higher of Newton's and of mean shift's. The derivatives are those of the maximum, up to the second.
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

    def goes_on(state: tuple[Array, Array, Array]) -> Array:
        number, _, (newton, _) = state
        return (number < _MOST_STEPS) & (jnp.sqrt(jnp.sum(newton**2)) > _TOLERANCE * fixed[2])

    start = jax.lax.stop_gradient(start)
    _, shift, _ = jax.lax.while_loop(goes_on, step, (jnp.zeros((), jnp.int32), start, _steps(start, *fixed)))
    for _ in range(2):  # of which each doubles the order of the derivatives that are right
        shift = shift + _steps(shift, shifts, weights, deviation)[0]
    return shift


def _pull(shift: Array, shifts: Array, weights: Array, deviation: Array) -> tuple[Array, Array]:
    """Offsets `[K, 2]` of the matches from a shift, and their weighted votes `[K]` for it."""
    offsets = shifts - shift[None]
    return offsets, weights * jnp.exp(-0.5 * jnp.sum((offsets / deviation) ** 2, axis=-1))


def _steps(shift: Array, shifts: Array, weights: Array, deviation: Array) -> Array:
    """`[2, 2]` Newton's step and that of mean shift (Comaniciu & Meer, PAMI 2002), px; 0 where nothing votes.

    Where the sum of votes is not concave, Newton's has a multiple of the identity more, so that it leads uphill.
    """
    offsets, pull = _pull(shift, shifts, weights, deviation)
    total = jnp.sum(pull)
    pull = jnp.where(total > 0, pull / jnp.where(total > 0, total, 1.0), 0.0)[:, None]
    mean, scaled = jnp.sum(pull * offsets, axis=0), offsets / deviation
    xx, yy = 1 - jnp.sum(pull * scaled**2, axis=0)
    xy = -jnp.sum(pull[:, 0] * scaled[:, 0] * scaled[:, 1])
    smallest = (xx + yy) / 2 - safe_sqrt(((xx - yy) / 2) ** 2 + xy**2)  # eigenvalue
    more = 2 * jnp.maximum(-smallest, 0.0)
    xx, yy = xx + more, yy + more
    volume = xx * yy - xy**2
    newton = jnp.stack([yy * mean[0] - xy * mean[1], xx * mean[1] - xy * mean[0]])
    newton = jnp.where(volume > 0, newton / jnp.where(volume > 0, volume, 1.0), mean)
    return jnp.stack([newton, mean])
