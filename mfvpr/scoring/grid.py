"""Grid anchors of SSM-VPR (Camara & Preucil, RAS 2020): how many cells of a patch keep their place beside its middle.

Both images are `side` x `side` cells, numbered row by row: the keypoint numbers of the matches. Every cell of the
candidate is matched with a cell of the query (`cross_check="candidate"`), index[cell]. Around each cell, its anchor, a
patch of n x n cells is as it should be where index[anchor + offset] = index[anchor] + offset.
"""

import jax
import jax.numpy as jnp

from mfvpr.scoring.fields import check_choices, choice, flag, whole
from mfvpr.scoring.weights import match_confidence
from mfvpr.types import Array, Matches, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import masked

LARGEST = 2**24  # whole numbers up to it are exact in float32
_OUTSIDE = {"unequal": -1000, "zero": 0}


@value
class GridAnchors:
    """s = the number of (anchor, cell of its patch) that agree, anchors themselves included, as the public code counts.

    It compares flat numbers: what should be off * side + column further may be at the other end of a row (`wrap`), and
    beyond the border of the grid stands a number that takes part (`outside`); with `wrap` False nothing does. A cell
    without a match agrees with none, not even with itself; of several matches of one cell that of the lowest query cell
    counts.

    Attributes:
        side: cells per side of both images, of which every keypoint is one: 40 at 336 px, 26 at 224, 54 at 448.
        patch: n, odd; None = three quarters of the side, rounded down, and one less where that is even.
        wrap: compare flat numbers, as published; False: displacements in rows and columns.
        outside: what stands beyond the border: "unequal" (-1000) as on the public code's CPU path, which nothing is
            equal to up to a side of 51; or "zero" as on its GPU path, where cell 0 of the query may be expected.
    """

    side: int = whole(40, "cells per side", "as the features have", bounds=(1, 74), swept=False)
    patch: int | None = whole(None, "cells", "odd; None = 3/4 of the side", bounds=(1, 73))
    wrap: bool = flag(True, "flat numbers are compared, as published")
    outside: str = choice("unequal", "zero", note="beyond the grid, of the CPU and of the GPU path")

    def __post_init__(self) -> None:
        check_choices(self)
        if self.side < 1 or not 1 <= self.size <= self.side or self.size % 2 == 0:
            raise InputError(f"GridAnchors(side={self.side}, patch={self.patch}): expected a side from 1, and an odd "
                             "patch up to it")  # fmt: skip
        if self.side**2 * self.size**2 > LARGEST:
            raise InputError(f"GridAnchors(side={self.side}, patch={self.patch}): expected scores up to 2^24, which "
                             "float32 holds exactly; choose fewer cells")  # fmt: skip

    @property
    def size(self) -> int:
        """n, cells per side of a patch."""
        if self.patch is not None:
            return self.patch
        size = 3 * self.side // 4
        return max(1, size - (size % 2 == 0))

    def __call__(self, matches: Matches) -> Array:
        """Score of one pair, `[]` float32; NaN where an image has another number of keypoints, or numbers beyond.

        Raises:
            InputError: nobody knows which keypoints the matches are of.
        """
        if matches.index0 is None or matches.index1 is None:
            raise InputError("GridAnchors: expected matches that know their keypoints (index0, index1), got none")
        real = match_confidence(matches) > 0
        cells = jnp.arange(self.side**2, dtype=jnp.int32)
        here, there = (jnp.where(real, jnp.asarray(index, jnp.int32), 0) for index in (matches.index1, matches.index0))
        target = jnp.where(real, here, len(cells))  # out of range: what is no match is dropped
        index = jnp.full(len(cells), len(cells), jnp.int32).at[target].min(there, mode="drop")
        matched = index < len(cells)
        score = self._agreements(index, matched, cells)
        if self.wrap:
            score += self._agreements_outside(index, matched, cells)
        counts = [jnp.asarray(count) for count in (matches.count0, matches.count1) if count is not None]
        usable = jnp.all((here >= 0) & (here < len(cells)) & (there >= 0) & (there < len(cells)))
        for count in counts:
            usable &= count == len(cells)
        return jnp.where(usable | ~jnp.any(real), score.astype(jnp.float32), jnp.nan)

    def _agreements(self, index: Array, matched: Array, cells: Array) -> Array:
        """Pairs of an anchor and a cell of its patch, both inside the grid, of one displacement.

        It is equal one way and the other, so that half of the offsets do: those to the right, and of all rows below.
        Rows are laid out with so much padding between them that an offset is a shift of the flat array.
        """
        side, half = self.side, self.size // 2
        shift = index - cells
        if not self.wrap:
            (row0, column0), (row1, column1) = (jnp.divmod(number, side) for number in (index, cells))
            shift = (row0 - row1) * 4 * side + column0 - column1
        pitch, never = side + half, 8 * side**2  # no displacement is as large
        anchors, others = (
            jnp.pad(masked(shift, matched, fill).reshape(side, side), ((0, 0), (0, half)), constant_values=fill)
            for fill in (never, -never)
        )
        anchors, width = anchors.reshape(-1), side * pitch
        others = jnp.pad(others.reshape(-1), (half, half * pitch + half), constant_values=-never)

        def agreeing(row: Array | int, columns: range) -> Array:
            """`[width]` int32, by anchor: how many of the offsets (row, column)."""
            below = jax.lax.dynamic_slice_in_dim(others, row * pitch, width + 2 * half)
            return sum(
                ((anchors == below[half + column : half + column + width]).astype(jnp.int32) for column in columns),
                start=jnp.zeros(width, jnp.int32),
            )

        right, whole_row = agreeing(0, range(1, half + 1)), range(-half, half + 1)
        counts = jax.lax.fori_loop(1, half + 1, lambda row, counts: counts + agreeing(row, whole_row), right)
        return 2 * jnp.sum(counts) + jnp.sum(matched, dtype=jnp.int32)

    def _agreements_outside(self, index: Array, matched: Array, cells: Array) -> Array:
        """Anchors whose patch has a cell beyond the grid where the number that stands there is the expected one."""
        side, half = self.side, self.size // 2
        row, column = jnp.divmod(cells, side)
        down, right = jnp.divmod(_OUTSIDE[self.outside] - index + half, side)  # the only offset, as n <= side
        right = right - half
        outside = (row + down < 0) | (row + down >= side) | (column + right < 0) | (column + right >= side)
        return jnp.sum(matched & (jnp.abs(down) <= half) & (right <= half) & outside, dtype=jnp.int32)
