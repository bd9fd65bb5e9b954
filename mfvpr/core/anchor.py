"""Anchor points (paper, section III-B): how many grid cells agree on their displacement with the cells around them.

Both images are divided into `num_bins` x `num_bins` cells (the paper's bins). The matches that start in cell (i, j) of
the first image vote for cells of the second image; the cell with the most votes is m_ij. The displacement of a cell is
d_ij = m_ij - (i, j); the norm in equation 2 of the paper is the distance |d_ij - d_kl|. Lengths are cells.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import Weight, image_sizes, match_confidence, match_weights, weight_field
from mfvpr.utils.fields import FLAG, POSITIVE, check_fields, one_of, setting, whole
from mfvpr.utils.numerics import at_least_single, masked, positive, safe_sqrt, where_finite

MAX_BINS = 215  # per side: numbers of pairs of cells then fit into 32 bits
_LEAST_SHARE = 1e-12  # smallest share of the winner's votes: keeps the gradient of the logarithm finite


@value
class AnchorPoints:
    """Agreement of the displacements of neighboring cells, equation 2.

        mfvpr.AnchorPoints(num_bins=15, tolerance=3.0)(matches)

    The score is summed over all anchors a (the paper's (i, j)) and all cells b in the window N around a (its (k, l)):

        s = sum_a w_a sum_{b in N} max(t - |d_a - d_b|, 0),

    where d are displacements, t is the tolerance, and w_a the weight of the anchor. The score does not change if all
    points of the second image move by the same number of whole cells and stay inside. With tolerance 1 and unit cell
    weights it counts exact agreements, as SSM-VPR does.

    Attributes:
        num_bins: cells per side, from 1 to 215. Memory grows with the square of the number of cells, or of matches if
            there are fewer; that of the soft form with the fourth power of num_bins.
        window: width of N, the square window around an anchor, cells.
        tolerance: t, distance of two displacements from which on they do not agree, cells.
        weight: match weight, FS by default as in the paper.
        window_mode: `half_floor` is window // 2 to each side (10 -> 11 x 11); `asymmetric` exactly window cells
            (10 -> -5 ... +4); `odd_down` the next odd number below (10 -> 9 x 9); `radius` window to each side.
        first: image whose cells are the anchors, `query` or `candidate`.
        include_self: an anchor counts itself.
        cell_weight: w_a, summed weights of the matches that voted for the winner, of all matches of the cell, or 1.
        temperature: without unit; T > 0 scores the soft form below. None is the paper's; an array
            not above 0 scores NaN.

    The soft form is smooth in points and weights. A point at u, in cells, belongs to cell c along an axis in proportion
    to e^(-(u - c - 1/2)^2 / T); A0 and A1 are these memberships in both images, and V = A0^T diag(w) A1 the votes of
    anchors for targets. The match of an anchor is the mean target position weighted by V^(1/T), and its `winner_sum`
    the mean of V weighted by V^(1/T): T -> 0 is the winner, T = 1 the mean of all votes. A cell with n matches is
    occupied to n^2 / (n^2 + T): this factor counts in the window, and is w_a if `cell_weight` is `ones`. Weights must
    not be negative. The window changes in whole cells, so that its gradient is 0. On matches of SIFT and ALIKED across
    seasons the soft score is within 3 % of the hard score (median; 90 % of pairs within 7 %) at T = 0.03, about 11 %
    below it at 0.1 and 43 % at 0.3.
    """

    num_bins: int = setting(15, whole(1, MAX_BINS), unit="cells per side", static=True)
    window: float | Array = setting(10.0, POSITIVE, unit="cells")
    tolerance: float | Array = setting(3.0, POSITIVE, unit="cells", learned=True)
    weight: Weight = weight_field("fs")
    window_mode: str = setting("half_floor", one_of("half_floor", "asymmetric", "odd_down", "radius"), static=True)
    first: str = setting("query", one_of("query", "candidate"), static=True)
    include_self: bool = setting(True, FLAG, static=True)
    cell_weight: str = setting("winner_sum", one_of("winner_sum", "cell_sum", "ones"), static=True)
    temperature: float | Array | None = setting(
        None, POSITIVE | None, "above 0 is smooth; None = the paper's", learned=True, start=0.03
    )

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        cells = self._cells if self.temperature is None else self._soft_cells
        index, rows, columns, occupancy, weights = cells(matches)
        # Two [cells, cells] planes, not one array with a trailing axis of 2, which costs nine times as much on a CPU.
        distance = safe_sqrt((rows[:, None] - rows[None]) ** 2 + (columns[:, None] - columns[None]) ** 2)
        support = masked(jnp.maximum(self.tolerance - distance, 0.0), self._neighbors(index)) * occupancy[None]
        score = jnp.sum(weights * jnp.sum(support, axis=1))  # equation 2, summed over the anchors
        return where_finite(score, match_weights(self.weight, matches), *self._positions(matches))

    def _cells(self, matches: Matches) -> tuple[Array, Array, Array, Array, Array]:
        """Cells of the first image, all occupied ones: number, displacement in rows and columns, occupancy, weight."""
        num_cells = self.num_bins**2
        weights = match_weights(self.weight, matches)

        def cell(position: Float[Array, "slots 2"]) -> Int[Array, " slots"]:
            """Row-major cell of each position, clipped to the image."""
            column, row = jnp.clip(jnp.floor(position), 0, self.num_bins - 1).astype(jnp.int32).T
            return row * self.num_bins + column

        anchor, target = map(cell, self._positions(matches))
        few = len(anchor) < num_cells
        vote = anchor * num_cells + target
        if few:  # matches, and very many pairs of cells
            strength = jnp.sum(jnp.where(vote[:, None] == vote[None], weights[:, None], 0.0), axis=0)
        else:
            strength = jnp.zeros(num_cells**2, weights.dtype).at[vote].add(weights)[vote]
        strength = jax.lax.stop_gradient(strength)  # the choice of the winner has no gradient; its weight below has
        real = match_confidence(matches) > 0
        member = jnp.where(real, anchor, num_cells)  # out of range, hence dropped, unless it is a match
        best = jnp.full(num_cells, -jnp.inf, weights.dtype).at[member].max(strength, mode="drop")
        contender = jnp.where(strength == best[anchor], target, num_cells)
        winner = jnp.full(num_cells, num_cells, jnp.int32).at[member].min(contender, mode="drop")

        if few:  # every match stands for its cell; only the first match of a cell counts
            slot = jnp.arange(len(anchor), dtype=jnp.int32)
            first_slot = jnp.full(num_cells, len(anchor), jnp.int32).at[member].min(slot, mode="drop")
            cells, occupied = anchor, real & (first_slot[anchor] == slot)
        else:
            cells = jnp.arange(num_cells, dtype=jnp.int32)
            occupied = winner < num_cells
        matched = jnp.where(occupied, winner[cells], cells)  # m
        rows = matched // self.num_bins - cells // self.num_bins
        columns = matched % self.num_bins - cells % self.num_bins
        if self.cell_weight == "ones":
            cell_weights = jnp.ones_like(occupied, weights.dtype)
        else:
            is_winner = target == winner[anchor]
            summands = jnp.where(is_winner, weights, 0.0) if self.cell_weight == "winner_sum" else weights
            cell_weights = jnp.zeros(num_cells, weights.dtype).at[anchor].add(summands)[cells]
        rows, columns, occupancy = (values.astype(weights.dtype) for values in (rows, columns, occupied))
        return cells, rows, columns, occupancy, masked(cell_weights, occupied)

    def _soft_cells(self, matches: Matches) -> tuple[Array, Array, Array, Array, Array]:
        """`_cells` of the soft form: all cells, smooth in points and weights."""
        weights = match_weights(self.weight, matches)
        temperature = positive(self.temperature, weights.dtype)
        anchor, target = (self._membership(position, temperature) for position in self._positions(matches))
        votes = jnp.matmul((anchor * weights[:, None]).T, target, precision=jax.lax.Precision.HIGHEST)
        count = jnp.sum(anchor * match_confidence(matches)[:, None], axis=0)
        occupancy = count**2 / (count**2 + temperature)

        most = jax.lax.stop_gradient(jnp.max(votes, axis=1, keepdims=True))  # a common factor, which drops out
        relative = votes / jnp.maximum(most, jnp.finfo(votes.dtype).tiny ** 0.5)
        shares = jax.nn.softmax(jnp.log(jnp.maximum(relative, _LEAST_SHARE)) / temperature, axis=1)

        cells = jnp.arange(self.num_bins**2, dtype=jnp.int32)
        row, column = (index.astype(votes.dtype) for index in jnp.divmod(cells, self.num_bins))
        rows, columns = (jnp.sum(shares * index[None], axis=1) - index for index in (row, column))
        cell_weights = {
            "winner_sum": lambda: jnp.sum(shares * votes, axis=1),
            "cell_sum": lambda: jnp.sum(votes, axis=1),
            "ones": lambda: occupancy,
        }[self.cell_weight]()
        return cells, rows, columns, occupancy, cell_weights

    def _positions(self, matches: Matches) -> tuple[Float[Array, "slots 2"], Float[Array, "slots 2"]]:
        """(x, y) of the points in the first and second image, in cells; 0 on padding."""
        size0, size1 = image_sizes(matches)
        query = masked(at_least_single(matches.points0), matches.mask) * self.num_bins / size0[None]
        candidate = masked(at_least_single(matches.points1), matches.mask) * self.num_bins / size1[None]
        return (query, candidate) if self.first == "query" else (candidate, query)

    def _membership(self, position: Float[Array, "slots 2"], temperature: Array) -> Float[Array, "slots cells"]:
        """Membership of each position in each cell, row-major; a row sums to 1."""
        centers = jnp.arange(self.num_bins, dtype=position.dtype) + 0.5
        distance = jnp.clip(position, 0, self.num_bins)[:, :, None] - centers[None, None]
        along = jax.nn.softmax(-(distance**2) / temperature, axis=-1)  # [K, (x, y), bins]
        return (along[:, 1, :, None] * along[:, 0, None, :]).reshape(len(position), self.num_bins**2)

    def _neighbors(self, cells: Int[Array, " cells"]) -> Bool[Array, "cells cells"]:
        """Entry (a, b): cell b lies in the window around cell a."""
        window = jnp.asarray(self.window, dtype=float)
        half, half_of_odd = jnp.floor(window / 2), jnp.floor((window - 1) / 2)
        low, high = {
            "half_floor": (-half, half),
            "asymmetric": (-half, window - half - 1),
            "odd_down": (-half_of_odd, half_of_odd),
            "radius": (-window, window),
        }[self.window_mode]
        row, column = (index.astype(float) for index in jnp.divmod(cells, self.num_bins))
        offsets = row[None] - row[:, None], column[None] - column[:, None]
        row_near, column_near = ((offset >= low) & (offset <= high) for offset in offsets)
        inside = row_near & column_near
        return inside if self.include_self else inside & (cells[None] != cells[:, None])
