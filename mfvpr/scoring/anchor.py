"""Anchor points (paper, section III-B): how many grid cells agree on their displacement with the cells around them.

Both images are divided into `num_bins` x `num_bins` cells. The matches that start in a cell of the first image vote
for cells of the second; the winner is the cell's match. A cell's displacement is its match minus itself, so the
paper's ||((i, j) - (k, l)) - (m_ij - m_kl)|| is the distance of two displacements. Lengths are cells.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from mfvpr.numerics import as_float, masked, safe_sqrt
from mfvpr.scoring.choices import check_choices, choice
from mfvpr.types import Array, Matches
from mfvpr.weighting import FeatureScoreWeight, Weight, match_weights


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AnchorPoints:
    """s = sum over anchor cells a of w_a sum over cells b in the window of max(tolerance - |d_a - d_b|, 0).

    The score does not change when all matches of the second image move by whole cells and stay inside. With
    tolerance 1 and unit cell weights it counts exact agreements, as SSM-VPR does.

    Attributes:
        num_bins: cells per side; memory grows with its fourth power.
        window: width of the square window around an anchor, cells.
        tolerance: largest distance of two displacements that still counts, cells.
        weight: match weight, FS by default as in the paper.
        window_mode: `half_floor` is window // 2 to each side (10 -> 11 x 11); `asymmetric` exactly window cells
            (10 -> -5 ... +4); `odd_down` the next odd number below (10 -> 9 x 9); `radius` window to each side.
        first: image whose cells are the anchors, `query` or `candidate`.
        include_self: an anchor counts itself.
        cell_weight: w_a is the winner's summed weight, the whole cell's, or 1.
    """

    num_bins: int = field(default=15, metadata={"static": True})
    window: float | Array = 10.0
    tolerance: float | Array = 3.0
    weight: Weight = FeatureScoreWeight()
    window_mode: str = choice("half_floor", "asymmetric", "odd_down", "radius")
    first: str = choice("query", "candidate")
    include_self: bool = field(default=True, metadata={"static": True})
    cell_weight: str = choice("winner_sum", "cell_sum", "ones")

    def __post_init__(self) -> None:
        check_choices(self)

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        rows, columns, occupied, weights = self._displacements(matches)
        # Two [cells, cells] planes, not one array with a trailing axis of 2, which costs nine times as much on a CPU.
        distance = safe_sqrt((rows[:, None] - rows[None]) ** 2 + (columns[:, None] - columns[None]) ** 2)
        support = jnp.maximum(self.tolerance - distance, 0.0)
        support = jnp.sum(masked(support, self._neighbors() & occupied[None]), axis=1)
        return jnp.sum(masked(weights * support, occupied))

    def _displacements(self, matches: Matches) -> tuple[Array, Array, Array, Array]:
        """Per cell of the first image, all `[cells]`: displacement in rows and in columns, has a match, weight."""
        num_cells = self.num_bins**2
        weights = match_weights(self.weight, matches)
        cell0 = self._cell(matches.points0, matches.image_size0, matches.mask)
        cell1 = self._cell(matches.points1, matches.image_size1, matches.mask)
        anchor, target = (cell0, cell1) if self.first == "query" else (cell1, cell0)

        vote = anchor * num_cells + target
        votes = jnp.zeros(num_cells**2, weights.dtype).at[vote].add(weights)
        strength = jax.lax.stop_gradient(votes[vote])  # [K]; which cell wins has no gradient, its weight below has
        member = jnp.where(matches.mask, anchor, num_cells)  # out of range: padding is dropped
        best = jnp.full(num_cells, -jnp.inf, weights.dtype).at[member].max(strength, mode="drop")
        contender = jnp.where(strength == best[anchor], target, num_cells)
        winner = jnp.full(num_cells, num_cells, jnp.int32).at[member].min(contender, mode="drop")

        cells = jnp.arange(num_cells, dtype=jnp.int32)
        occupied = winner < num_cells
        winner = jnp.where(occupied, winner, cells)
        rows, columns = winner // self.num_bins - cells // self.num_bins, winner % self.num_bins - cells % self.num_bins
        cell_weights = {
            "winner_sum": lambda: votes[cells * num_cells + winner],
            "cell_sum": lambda: jnp.sum(votes.reshape(num_cells, num_cells), axis=1),
            "ones": lambda: jnp.ones(num_cells, weights.dtype),
        }[self.cell_weight]()
        return rows.astype(weights.dtype), columns.astype(weights.dtype), occupied, cell_weights

    def _cell(self, points: Array, image_size: Array, mask: Array) -> Array:
        """`[K]` int32 row-major cell of each point; points outside belong to the border."""
        position = jnp.floor(masked(as_float(points), mask) * self.num_bins / as_float(image_size)[None])
        column, row = jnp.clip(position, 0, self.num_bins - 1).astype(jnp.int32).T
        return row * self.num_bins + column

    def _neighbors(self) -> Array:
        """`[cells, cells]` True where the second cell lies in the window around the first."""
        index = jnp.arange(self.num_bins, dtype=float)
        offset = index[None] - index[:, None]
        low, high = self._reach()
        near = (offset >= low) & (offset <= high)  # [bins, bins], along either axis
        inside = near[:, None, :, None] & near[None, :, None, :]
        inside = inside.reshape(self.num_bins**2, self.num_bins**2)
        return inside if self.include_self else inside & ~jnp.eye(len(inside), dtype=bool)

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
