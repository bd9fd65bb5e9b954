"""The tallest bin of a histogram of shifts without most of its bins: branch and bound.

Bins are cut into square blocks. A cheap upper bound of every block's bins is one product of about a hundredth of the
histogram's size; then the most promising blocks are evaluated bin by bin, until no other block's bound exceeds the
tallest bin found. Lengths are pixels.

Why nothing is lost. With w+ = max(w, 0), every bin c of a block holds at most

- sum_k w+_k max_c g(x_k - c_x) max_c g(y_k - c_y), the vote for the block's column and row nearest to the match; and
- e^(h^2 / 4 s^2) times the largest of the untruncated sums at the corners of the square of width h that holds the
  block's bins: with c counted from its middle, f(c) e^(|c|^2 / 2 s^2) is a sum of exponentials of linear functions of
  c with weights w+, hence convex, hence largest at a corner, where |c|^2 = h^2 / 2.

The first is used where blocks are wider than the deviation s, the second elsewhere, where it is the closer one. Bounds
are raised by a relative 2^-10 + K 2^-22, more than float32 rounds off sums of K votes (down to 1e-35 of a weight), and
a block is left out only where its raised bound does not exceed a bin that was evaluated. So no vote is neglected: the
result is the maximum over all bins, as exact as their float32 sums, whatever the weights, and as long as the deviation
is many times what float32 rounds a position to.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from mfvpr.core.lattice import Lattice, gaussian, pool_bins, votes_along
from mfvpr.core.types import Array

BLOCKS_AT_ONCE = 4
MOST_ROUNDS = 16  # after so many rounds, evaluating all bins is cheaper
WORTHWHILE = 2**13  # bins times weightings above which the bounds cost less than all bins
PAIRS_AT_ONCE = 8  # divided by the weightings: few and long operations that still stay in the cache
_SLACK = 2**-10  # relative; covers the rounding of positions and exponentials
_SLACK_PER_MATCH = 2**-22  # relative; covers the rounding of sums


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def tallest_bins(
    shifts: Float[Array, "candidates 2 slots"],
    weights: Float[Array, "candidates weightings slots"],
    lattice: Lattice,
    capacity: int,
) -> Float[Array, "candidates weightings"]:
    """Scores of the tallest of `capacity` x `capacity` bins of pairs, with several weights of each match.

    The derivative is the one of the maximum over all bins. A weight that is not finite scores NaN.
    """
    pairs, num_weights = (shifts, weights, lattice), weights.shape[1]
    if capacity**2 * num_weights <= WORTHWHILE:
        return _all_bins(pairs, capacity, batch_size=max(1, PAIRS_AT_ONCE // num_weights))

    def score_pair(pair: Any) -> Array:
        scores, is_proven = search_blocks(*pair, capacity=capacity)
        return jax.lax.cond(is_proven, lambda: scores, lambda: pool_bins(*pair, capacity=capacity))

    return jax.lax.map(score_pair, pairs)


@tallest_bins.defjvp
def _derivative(capacity: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return jax.jvp(lambda *pairs: _all_bins(pairs, capacity), primals, tangents)


def _all_bins(pairs: Any, capacity: int, *, batch_size: int | None = None) -> Array:
    return jax.lax.map(lambda pair: pool_bins(*pair, capacity=capacity), pairs, batch_size=batch_size)


def search_blocks(
    shifts: Float[Array, "2 slots"], weights: Float[Array, "weightings slots"], lattice: Lattice, capacity: int
) -> tuple[Float[Array, " weightings"], Bool[Array, ""]]:
    """Scores of the tallest bins of one pair, and whether no bin can be taller."""
    side = block_side(capacity)
    count = -(-capacity // side)
    usable = jnp.all(jnp.isfinite(weights), axis=1)
    bounds = block_bounds(shifts, jnp.where(usable[:, None], weights, 0.0), lattice, side, count)

    def next_blocks(tallest: Array, open_blocks: Array) -> tuple[Array, Array]:
        """(factors, blocks) of open blocks: largest factors by which bounds exceed the tallest bins."""
        below = jnp.where(tallest < 0, jnp.inf, 0.0)  # with negative weights even a bin without votes may be taller
        tallest = jnp.where(tallest > 0, tallest, jnp.finfo(tallest.dtype).tiny)
        factors = jnp.max(bounds / tallest[None, :, None] + below[None, :, None], axis=1).reshape(-1)
        return jax.lax.top_k(jnp.where(open_blocks, factors, 0.0), min(BLOCKS_AT_ONCE, count**2))

    def step(state: tuple) -> tuple:
        rounds, tallest, open_blocks, _, blocks = state
        tallest = jnp.maximum(tallest, evaluate_blocks(blocks, shifts, weights, lattice, side, count))
        open_blocks = open_blocks.at[blocks].set(False)
        return rounds + 1, tallest, open_blocks, *next_blocks(tallest, open_blocks)

    open_blocks, lowest = jnp.ones(count**2, bool), jnp.full(len(weights), -jnp.inf, bounds.dtype)
    start = step((0, lowest, open_blocks, *next_blocks(jnp.max(bounds, axis=(0, 2)), open_blocks)))
    state = jax.lax.while_loop(lambda state: (state[3][0] > 1) & (state[0] < MOST_ROUNDS), step, start)
    _, tallest, _, factors, _ = state
    # Many blocks stay open if the histogram is so flat that all bins are nearly as tall.
    return jnp.where(usable, tallest, jnp.nan), factors[0] <= 1


def block_side(capacity: int) -> int:
    """Bins along one side of a block."""
    return 2 if capacity <= 48 else 3 if capacity <= 96 else 4 if capacity <= 256 else 8


def block_bounds(
    shifts: Float[Array, "2 slots"], weights: Float[Array, "weightings slots"], lattice: Lattice, side: int, count: int
) -> Float[Array, "blocks_y weightings blocks_x"]:
    """Upper bounds of the bins of every block, 0 out of range."""
    width = side * lattice.bin_size
    narrow = width <= lattice.deviation
    start = side * jnp.arange(count + 1, dtype=shifts.dtype)
    votes_x, votes_y = (_block_votes(shifts[axis], axis, start, lattice, side, narrow) for axis in (0, 1))
    raised = jnp.maximum(weights, 0.0) * (1 + _SLACK + _SLACK_PER_MATCH * weights.shape[1])
    columns = (raised[:, None] * votes_x[None]).reshape(-1, weights.shape[1])
    sums = jnp.matmul(votes_y, columns.T, precision=jax.lax.Precision.HIGHEST)
    sums = sums.reshape(count + 1, len(weights), count + 1)

    corners = jnp.maximum(sums[1:], sums[:-1])
    corners = jnp.maximum(corners[..., 1:], corners[..., :-1])
    bounds = jnp.where(narrow, corners * jnp.exp((width / (2 * lattice.deviation)) ** 2), sums[:-1, :, :-1])
    x, y = (start[:-1] < lattice.num_bins[axis] for axis in (0, 1))
    return jnp.where(y[:, None, None] & x[None, None], bounds, 0.0)


def _block_votes(
    shifts: Array, axis: int, start: Array, lattice: Lattice, side: int, narrow: Array
) -> Float[Array, "blocks slots"]:
    """Votes along one axis for the first bin of narrow blocks, else the nearest."""
    last = lattice.num_bins[axis] - 1
    lower = lattice.centers(axis, start)[:, None]
    upper = lattice.centers(axis, jnp.minimum(start + (side - 1), last))[:, None]
    below = jnp.floor((shifts - lattice.first[axis]) / lattice.bin_size)
    neighbors = (lattice.centers(axis, jnp.clip(below + step, 0, last)) for step in (0, 1))
    nearest = jnp.minimum(*(jnp.abs(shifts - center) for center in neighbors))  # of all bins
    distance = jnp.maximum(jnp.maximum(lower - shifts[None], shifts[None] - upper), nearest[None])
    distance = jnp.where(narrow, lower - shifts[None], distance)
    truncate = lattice.truncate * (1 + _SLACK)  # a match on the edge may be rounded to either side
    return gaussian(distance, lattice.deviation, jnp.where(narrow, jnp.inf, truncate))


def evaluate_blocks(
    blocks: Int[Array, " blocks"],
    shifts: Float[Array, "2 slots"],
    weights: Float[Array, "weightings slots"],
    lattice: Lattice,
    side: int,
    count: int,
) -> Float[Array, " weightings"]:
    """Scores of the tallest bin within range in some blocks."""
    inner = jnp.arange(side, dtype=shifts.dtype)[None]

    def along(axis: int, block: Array) -> Array:
        return votes_along(axis, block.astype(shifts.dtype)[:, None] * side + inner, shifts, lattice)

    votes_x, votes_y = along(0, blocks % count), along(1, blocks // count)
    weighted = (weights[None, :, None] * votes_y[:, None]).reshape(len(blocks), -1, weights.shape[1])
    bins = jnp.matmul(weighted, jnp.swapaxes(votes_x, 1, 2), precision=jax.lax.Precision.HIGHEST)
    return jnp.max(bins.reshape(len(blocks), len(weights), -1), axis=(0, 2))
