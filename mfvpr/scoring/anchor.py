"""Anchor points (paper, section III-B): how many grid cells agree on their displacement with the cells around them.

Both images are divided into `num_bins` x `num_bins` cells. The matches that start in a cell of the first image vote
for cells of the second; the winner is the cell's match. A cell's displacement is its match minus itself, so the
paper's ||((i, j) - (k, l)) - (m_ij - m_kl)|| is the distance of two displacements. Lengths are cells.
"""

from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp

from mfvpr.numerics import masked, safe_sqrt
from mfvpr.types import Array, Matches
from mfvpr.weighting import FeatureScoreWeight, Weight, match_weights


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AnchorPoints:
    """s = sum over anchor cells a of w_a sum over cells b in the window of max(tolerance - |d_a - d_b|, 0).

    The score does not change when all matches of the second image move by whole cells and stay inside. With
    tolerance 1 and unit cell weights it counts exact agreements, as SSM-VPR does.

    Attributes:
        window: width of the square window around an anchor, cells.
        tolerance: largest distance of two displacements that still counts, cells.
        weight: match weight, FS by default as in the paper.
        num_bins: cells per side (facts A14).
        window_mode: `half_floor` is window // 2 to each side (10 -> 11 x 11); `asymmetric` exactly window cells
            (10 -> -5 ... +4); `odd_down` the next odd number below (10 -> 9 x 9); `radius` window to each side (A18).
        first: image whose cells are the anchors, `query` or `candidate` (facts A16).
        include_self: an anchor counts itself (facts A19).
        cell_weight: w_a is the winner's summed weight, the whole cell's, or 1 (facts A17).
    """

    window: float | Array = 10
    tolerance: float | Array = 3.0
    weight: Weight = FeatureScoreWeight()
    num_bins: int = field(default=15, metadata={"static": True})
    window_mode: Literal["half_floor", "asymmetric", "odd_down", "radius"] = field(
        default="half_floor", metadata={"static": True}
    )
    first: Literal["query", "candidate"] = field(default="query", metadata={"static": True})
    include_self: bool = field(default=True, metadata={"static": True})
    cell_weight: Literal["winner_sum", "cell_sum", "ones"] = field(default="winner_sum", metadata={"static": True})

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        displacement, occupied, weights = self._displacements(matches)
        difference = displacement[:, None] - displacement[None]  # [cells, cells, 2]
        support = jnp.maximum(self.tolerance - safe_sqrt(jnp.sum(difference**2, axis=-1)), 0.0)
        support = masked(support, self._neighbors() & occupied[None])
        return jnp.sum(masked(weights, occupied) * jnp.sum(support, axis=1))

    def _displacements(self, matches: Matches) -> tuple[Array, Array, Array]:
        """Per cell of the first image: displacement `[cells, 2]`, has a match `[cells]`, weight `[cells]`."""
        weights = match_weights(self.weight, matches)
        cell0 = self._cell(matches.points0, matches.image_size0, matches.mask)
        cell1 = self._cell(matches.points1, matches.image_size1, matches.mask)
        anchor, target = (cell0, cell1) if self.first == "query" else (cell1, cell0)

        same_vote = (anchor[:, None] == anchor[None]) & (target[:, None] == target[None])  # [K, K]
        vote = jnp.sum(jnp.where(same_vote, weights[None], 0.0), axis=1)  # [K] total of the match's (cell, target)
        cells = jnp.arange(self.num_bins**2)
        member = (anchor[None] == cells[:, None]) & matches.mask[None]  # [cells, K]
        best = jnp.max(jnp.where(member, vote[None], -jnp.inf), axis=1)
        winner = jnp.min(jnp.where(member & (vote[None] == best[:, None]), target[None], len(cells)), axis=1)

        occupied = jnp.any(member, axis=1)
        displacement = self._position(winner) - self._position(cells)
        if self.cell_weight == "winner_sum":
            return displacement, occupied, masked(best, occupied)
        if self.cell_weight == "cell_sum":
            return displacement, occupied, jnp.sum(jnp.where(member, weights[None], 0.0), axis=1)
        return displacement, occupied, jnp.ones(cells.shape)

    def _cell(self, points: Array, image_size: Array, mask: Array) -> Array:
        """`[K]` int32 row-major cell of each point; points outside belong to the border (facts A15)."""
        position = jnp.floor(masked(points, mask) * self.num_bins / image_size[None])
        column, row = jnp.clip(position, 0, self.num_bins - 1).astype(jnp.int32).T
        return row * self.num_bins + column

    def _position(self, cells: Array) -> Array:
        """`[..., 2]` (row, column) of row-major cells, float."""
        return jnp.stack([cells // self.num_bins, cells % self.num_bins], axis=-1).astype(float)

    def _neighbors(self) -> Array:
        """`[cells, cells]` True where the second cell lies in the window around the first."""
        row, column = self._position(jnp.arange(self.num_bins**2)).T
        rows, columns = row[None] - row[:, None], column[None] - column[:, None]
        low, high = self._reach()
        inside = (rows >= low) & (rows <= high) & (columns >= low) & (columns <= high)
        return inside if self.include_self else inside & ~jnp.eye(len(row), dtype=bool)

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
