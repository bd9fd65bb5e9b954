"""Geometry-preserving visual phrases (Zhang et al., CVPR 2011): how many groups of matches share a cell of shifts."""

import jax
import jax.numpy as jnp

from mfvpr.scoring.fields import check_choices, choice, number, whole
from mfvpr.scoring.shifts import match_shifts
from mfvpr.scoring.weights import match_confidence
from mfvpr.types import Array, Matches, value
from mfvpr.utils.numerics import masked, positive, where_finite

MAX_LENGTH = 8  # the phrases of 100,000 matches are still a number of float32


@value
class VisualPhrases:
    """s = sum over cells of C(m, length), the phrases that the m matches with a shift in one cell make.

    The plane of shifts, points1 - points0, is divided into square cells. Length 1 counts the matches, length 2 the
    pairs that agree. A phrase counts the product of its matches' confidences, so that m need not be whole: matches of
    confidence 0 are none, and where no cell has `length` matches the score is 0.

    The score is smooth in the confidences; where the points are it notices only by cells, with a gradient of 0. Matches
    are sorted by cell, so that time and memory are those of the matches, whatever the number of cells.

    Attributes:
        length: matches of a phrase.
        cell_size: width of the cells, px; not above 0 scores NaN.
        align: `zero_center` centers a cell on shift 0; `zero_edge` puts an edge there. Edges belong to the cell above.
    """

    length: int = whole(2, "matches of a phrase", bounds=(1, MAX_LENGTH))
    cell_size: float | Array = number(15.0, "px")
    align: str = choice("zero_center", "zero_edge")

    def __post_init__(self) -> None:
        check_choices(self)
        if not 1 <= self.length <= MAX_LENGTH:
            raise ValueError(f"VisualPhrases(length={self.length}): expected from 1 to {MAX_LENGTH} matches")

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32."""
        confidence, cells = match_confidence(matches), self._cells(matches)
        rows, columns, votes = jax.lax.sort((cells[:, 1], cells[:, 0], confidence), num_keys=2)
        changed = (rows != jnp.roll(rows, 1)) | (columns != jnp.roll(columns, 1))
        first = changed.at[:1].set(True)  # of its cell
        return where_finite(jnp.sum(_ending(votes, first, self.length)), confidence, cells)

    def _cells(self, matches: Matches) -> Array:
        """`[K, 2]` (column, row) of each match's shift, whole; 0 on padding."""
        shifts = match_shifts(matches)
        size = positive(self.cell_size, shifts.dtype)
        start = shifts + size / 2 if self.align == "zero_center" else shifts
        cells = jnp.floor(start / size)
        # A quotient may be rounded to either side of a whole number, and otherwise in another program.
        above, below = start >= (cells + 1) * size, start < cells * size
        return masked(cells + above.astype(cells.dtype) - below.astype(cells.dtype), matches.mask)


def _ending(votes: Array, first: Array, length: int) -> Array:
    """`[K]` phrases of sorted matches `[K]` of which each is the last; `first` are those that begin a cell."""
    none = jnp.zeros(length, votes.dtype).at[0].set(1.0)

    def step(shorter: Array, match: tuple[Array, Array]) -> tuple[Array, Array]:
        vote, begins = match
        shorter = jnp.where(begins, none, shorter)  # phrases of 0, ..., length - 1 matches of the cell before this one
        longer = vote * shorter  # of 1, ..., length, with it
        return shorter.at[1:].add(longer[:-1]), longer[-1]

    # By sums of products alone, so that what is too few for a phrase is exactly 0.
    return jax.lax.scan(step, none, (votes, first))[1]
