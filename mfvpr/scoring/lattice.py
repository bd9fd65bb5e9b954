"""The bins of a histogram of shifts, and the votes of matches for them. Lengths are pixels."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mfvpr.types import Array


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

    return one(weights[0])[None] if len(weights) == 1 else jax.lax.map(one, weights)
