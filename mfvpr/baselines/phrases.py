"""Geometry-preserving visual phrases (Zhang et al., CVPR 2011): how many groups of matches share a cell of shifts."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import match_confidence, match_shifts
from mfvpr.utils.fields import POSITIVE, check_fields, one_of, setting, whole
from mfvpr.utils.numerics import masked, positive, where_finite

MAX_LENGTH = 8  # the number of phrases of 100,000 matches still fits into float32


@value
class VisualPhrases:
    """Number of phrases: groups of `length` matches with shifts in the same cell.

        mfvpr.VisualPhrases(length=2, cell_size=15.0)(matches)

    s = sum over cells of C(m, length), where m matches have a shift in the cell. The plane of shifts, points1 -
    points0, is divided into square cells. Length 1 counts matches, length 2 pairs of matches that agree. A phrase
    counts the product of its matches' confidences, so that matches of confidence 0 do not count. The score is 0 if no
    cell has `length` matches. It is smooth in the confidences, and constant in the points within a cell (gradient 0).

    Attributes:
        length: matches per phrase, from 1 to 8 (else a ValueError).
        cell_size: width of the cells, px; an array not above 0 scores NaN.
        align: `zero_center` centers a cell on shift 0; `zero_edge` puts an edge there. Edges belong to the upper cell.
    """

    length: int = setting(2, whole(1, MAX_LENGTH), unit="matches of a phrase", static=True)
    cell_size: float | Array = setting(15.0, POSITIVE, unit="px")
    align: str = setting("zero_center", one_of("zero_center", "zero_edge"), static=True)

    __post_init__ = check_fields

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32."""
        confidence, cells = match_confidence(matches), self._cells(matches)
        rows, columns, votes = jax.lax.sort((cells[:, 1], cells[:, 0], confidence), num_keys=2)
        differs = (rows != jnp.roll(rows, 1)) | (columns != jnp.roll(columns, 1))
        is_first = differs.at[:1].set(True)  # of its cell
        return where_finite(jnp.sum(_count_phrases(votes, is_first, self.length)), confidence, cells)

    def _cells(self, matches: Matches) -> Float[Array, "slots 2"]:
        """(column, row) of the cell of each match's shift, integers; 0 on padding."""
        shifts = match_shifts(matches)
        size = positive(self.cell_size, shifts.dtype)
        start = shifts + size / 2 if self.align == "zero_center" else shifts
        cells = jnp.floor(start / size)
        # Another program may round a quotient near an integer to the other side.
        above, below = start >= (cells + 1) * size, start < cells * size
        return masked(cells + above.astype(cells.dtype) - below.astype(cells.dtype), matches.mask)


def _count_phrases(
    votes: Float[Array, " slots"], is_first: Bool[Array, " slots"], length: int
) -> Float[Array, " slots"]:
    """Phrases that end with each of the sorted matches; `is_first` begins a cell."""
    empty = jnp.zeros(length, votes.dtype).at[0].set(1.0)

    def step(shorter: Array, match: tuple[Array, Array]) -> tuple[Array, Array]:
        vote, begins = match
        shorter = jnp.where(begins, empty, shorter)  # phrases of 0, ..., length - 1 earlier matches of the cell
        longer = vote * shorter  # phrases of 1, ..., length matches that end with this one
        return shorter.at[1:].add(longer[:-1]), longer[-1]

    # Only sums of products, so that cells with too few matches count exactly 0.
    return jax.lax.scan(step, empty, (votes, is_first))[1]
