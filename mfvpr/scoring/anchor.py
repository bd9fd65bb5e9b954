"""Anchor points (paper, section III-B): how many grid cells agree on their displacement with the cells around them.

Both images are divided into `num_bins` x `num_bins` cells. The matches that start in a cell of the first image vote
for cells of the second; the winner is the cell's match. A cell's displacement is its match minus itself, so the
paper's ||((i, j) - (k, l)) - (m_ij - m_kl)|| is the distance of two displacements. Lengths are cells.
"""

import jax
import jax.numpy as jnp

from mfvpr.scoring.fields import check_choices, choice, flag, named, number, whole
from mfvpr.scoring.shifts import image_sizes
from mfvpr.scoring.weight_registry import NAMED_WEIGHTS, SUFFIX
from mfvpr.scoring.weights import Weight, match_confidence, match_weights
from mfvpr.types import Array, Matches, value
from mfvpr.utils.numerics import at_least_single, masked, positive, safe_sqrt, where_finite

MAX_BINS = 215  # per side: pairs of cells are then still numbers of 32 bits
_LEAST_SHARE = 1e-12  # of the winner's votes, below which a target has none: keeps the logarithm's gradient finite


@value
class AnchorPoints:
    """s = sum over anchor cells a of w_a sum over cells b in the window of max(tolerance - |d_a - d_b|, 0).

    The score does not change when all matches of the second image move by whole cells and stay inside. With
    tolerance 1 and unit cell weights it counts exact agreements, as SSM-VPR does.

    Attributes:
        num_bins: cells per side; memory grows with the square of the number of cells, or of matches where these are
            fewer, and that of the soft form with the fourth power of num_bins.
        window: width of the square window around an anchor, cells.
        tolerance: largest distance of two displacements that still counts, cells.
        weight: match weight, FS by default as in the paper.
        window_mode: `half_floor` is window // 2 to each side (10 -> 11 x 11); `asymmetric` exactly window cells
            (10 -> -5 ... +4); `odd_down` the next odd number below (10 -> 9 x 9); `radius` window to each side.
        first: image whose cells are the anchors, `query` or `candidate`.
        include_self: an anchor counts itself.
        cell_weight: w_a is the winner's summed weight, the whole cell's, or 1.
        temperature: without unit; T > 0 scores the soft form below. None is the paper's; not above 0 scores NaN.

    The soft form, smooth in points and weights: a point at u, in cells, belongs to cell c along an axis in proportion
    to e^(-(u - c - 1/2)^2 / T), so that V = A0^T diag(w) A1 are the votes of anchors for targets. An anchor's match is
    the mean target position, weighted by V^(1/T), and its winner's summed weight the mean of V, weighted likewise:
    T -> 0 is the winner, T = 1 the mean of all votes. A cell with n matches is occupied to n^2 / (n^2 + T), which it
    counts in the window, and weighs where w_a is 1. Weights must not be negative. The window moves in whole cells: its
    gradient is 0. On matches of SIFT and ALIKED across seasons the soft score is within 3 % of the hard one (median; 90
    % of pairs within 7 %) at T = 0.03, some 11 % below it at 0.1 and 43 % at 0.3.
    """

    num_bins: int = whole(15, "cells per side", bounds=(1, 32))  # the soft form's memory
    window: float | Array = number(10.0, "cells")
    tolerance: float | Array = number(3.0, "cells", learned=True)
    weight: Weight = named(NAMED_WEIGHTS, "fs", file=SUFFIX)
    window_mode: str = choice("half_floor", "asymmetric", "odd_down", "radius")
    first: str = choice("query", "candidate")
    include_self: bool = flag(True)
    cell_weight: str = choice("winner_sum", "cell_sum", "ones")
    temperature: float | Array | None = number(
        None, note="above 0 is smooth; None = the paper's", learned=True, start=0.03
    )

    def __post_init__(self) -> None:
        check_choices(self)
        if not 0 < self.num_bins <= MAX_BINS:
            raise ValueError(f"AnchorPoints(num_bins={self.num_bins}): expected from 1 to {MAX_BINS} cells per side")

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        cells = self._cells if self.temperature is None else self._soft_cells
        index, rows, columns, occupancy, weights = cells(matches)
        # Two [cells, cells] planes, not one array with a trailing axis of 2, which costs nine times as much on a CPU.
        distance = safe_sqrt((rows[:, None] - rows[None]) ** 2 + (columns[:, None] - columns[None]) ** 2)
        support = masked(jnp.maximum(self.tolerance - distance, 0.0), self._neighbors(index)) * occupancy[None]
        score = jnp.sum(weights * jnp.sum(support, axis=1))
        return where_finite(score, match_weights(self.weight, matches), *self._positions(matches))

    def _cells(self, matches: Matches) -> tuple[Array, Array, Array, Array, Array]:
        """Row-major number of some cells of the first image, all that are occupied among them, and of each of them:
        displacement in rows and in columns, occupancy, weight."""
        num_cells = self.num_bins**2
        weights = match_weights(self.weight, matches)
        anchor, target = (self._cell(position) for position in self._positions(matches))
        few = len(anchor) < num_cells

        vote = anchor * num_cells + target
        # Which cell wins has no gradient, its weight below has.
        strength = jax.lax.stop_gradient(_sums_by_key(weights, vote, num_cells**2, pairwise=few))  # [K]
        real = match_confidence(matches) > 0
        member = jnp.where(real, anchor, num_cells)  # out of range: what is no match is dropped
        best = jnp.full(num_cells, -jnp.inf, weights.dtype).at[member].max(strength, mode="drop")
        contender = jnp.where(strength == best[anchor], target, num_cells)
        winner = jnp.full(num_cells, num_cells, jnp.int32).at[member].min(contender, mode="drop")

        if few:  # every match stands for its cell, of which the first counts
            number = jnp.arange(len(anchor), dtype=jnp.int32)
            first = jnp.full(num_cells, len(anchor), jnp.int32).at[member].min(number, mode="drop")
            cells, occupied = anchor, real & (first[anchor] == number)
        else:
            cells = jnp.arange(num_cells, dtype=jnp.int32)
            occupied = winner < num_cells
        won = jnp.where(occupied, winner[cells], cells)
        rows, columns = won // self.num_bins - cells // self.num_bins, won % self.num_bins - cells % self.num_bins
        if self.cell_weight == "ones":
            cell_weights = jnp.ones_like(occupied, weights.dtype)
        else:
            won_votes = target == winner[anchor]
            counted = jnp.where(won_votes, weights, 0.0) if self.cell_weight == "winner_sum" else weights
            cell_weights = jnp.zeros(num_cells, weights.dtype).at[anchor].add(counted)[cells]
        rows, columns, occupancy = (values.astype(weights.dtype) for values in (rows, columns, occupied))
        return cells, rows, columns, occupancy, masked(cell_weights, occupied)

    def _soft_cells(self, matches: Matches) -> tuple[Array, Array, Array, Array, Array]:
        """As `_cells`, of all cells, smooth in points and weights."""
        weights = match_weights(self.weight, matches)
        temperature = positive(self.temperature, weights.dtype)
        anchor, target = (self._membership(position, temperature) for position in self._positions(matches))
        votes = jnp.matmul((anchor * weights[:, None]).T, target, precision=jax.lax.Precision.HIGHEST)
        count = jnp.sum(anchor * match_confidence(matches)[:, None], axis=0)
        occupancy = count**2 / (count**2 + temperature)

        most = jax.lax.stop_gradient(jnp.max(votes, axis=1, keepdims=True))  # a common factor, which drops out
        share = votes / jnp.maximum(most, jnp.finfo(votes.dtype).tiny ** 0.5)
        chosen = jax.nn.softmax(jnp.log(jnp.maximum(share, _LEAST_SHARE)) / temperature, axis=1)

        cells = jnp.arange(self.num_bins**2, dtype=jnp.int32)
        row, column = (index.astype(votes.dtype) for index in jnp.divmod(cells, self.num_bins))
        rows, columns = (jnp.sum(chosen * index[None], axis=1) - index for index in (row, column))
        cell_weights = {
            "winner_sum": lambda: jnp.sum(chosen * votes, axis=1),
            "cell_sum": lambda: jnp.sum(votes, axis=1),
            "ones": lambda: occupancy,
        }[self.cell_weight]()
        return cells, rows, columns, occupancy, cell_weights

    def _positions(self, matches: Matches) -> tuple[Array, Array]:
        """`[K, 2]` (x, y) of all points of the anchors' image and of the other, in cells; 0 on padding."""
        size0, size1 = image_sizes(matches)
        query = masked(at_least_single(matches.points0), matches.mask) * self.num_bins / size0[None]
        candidate = masked(at_least_single(matches.points1), matches.mask) * self.num_bins / size1[None]
        return (query, candidate) if self.first == "query" else (candidate, query)

    def _cell(self, position: Array) -> Array:
        """`[K]` int32 row-major cell of each position; those outside belong to the border."""
        column, row = jnp.clip(jnp.floor(position), 0, self.num_bins - 1).astype(jnp.int32).T
        return row * self.num_bins + column

    def _membership(self, position: Array, temperature: Array) -> Array:
        """`[K, cells]` how far each position belongs to each cell, row-major, sums to 1."""
        centers = jnp.arange(self.num_bins, dtype=position.dtype) + 0.5
        distance = jnp.clip(position, 0, self.num_bins)[:, :, None] - centers[None, None]
        along = jax.nn.softmax(-(distance**2) / temperature, axis=-1)  # [K, (x, y), bins]
        return (along[:, 1, :, None] * along[:, 0, None, :]).reshape(len(position), self.num_bins**2)

    def _neighbors(self, cells: Array) -> Array:
        """`[n, n]` True where the second of some cells `[n]` lies in the window around the first."""
        low, high = self._reach()
        row, column = (index.astype(float) for index in jnp.divmod(cells, self.num_bins))
        offsets = row[None] - row[:, None], column[None] - column[:, None]
        row_near, column_near = ((offset >= low) & (offset <= high) for offset in offsets)
        inside = row_near & column_near
        return inside if self.include_self else inside & (cells[None] != cells[:, None])

    def _reach(self) -> tuple[Array, Array]:
        """Lowest and highest offset of a neighbor."""
        window = jnp.asarray(self.window, dtype=float)
        half = jnp.floor(window / 2)
        if self.window_mode == "half_floor":
            return -half, half
        if self.window_mode == "asymmetric":
            return -half, window - half - 1
        if self.window_mode == "odd_down":
            half = jnp.floor((window - 1) / 2)
            return -half, half
        return -window, window


def _sums_by_key(values: Array, keys: Array, num_keys: int, *, pairwise: bool) -> Array:
    """`[K]` for each, the sum of all `values` `[K]` of its key."""
    if pairwise:  # few values and very many keys
        return jnp.sum(jnp.where(keys[:, None] == keys[None], values[:, None], 0.0), axis=0)
    return jnp.zeros(num_keys, values.dtype).at[keys].add(values)[keys]
