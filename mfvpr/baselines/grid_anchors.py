"""Grid anchors of SSM-VPR (Camara & Preucil, RAS 2020): how many cells of a patch keep their place beside its middle.

Both images are `side` x `side` cells, numbered row by row; these are the keypoint numbers of the matches. Every cell of
the candidate is matched with a cell of the query, index[cell] (`cross_check="candidate"`). Every cell is the anchor of
a patch of n x n cells around it. A cell of the patch agrees if index[anchor + offset] = index[anchor] + offset.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.core.types import Array, Matches, value
from mfvpr.core.weights import match_confidence
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import check_fields, one_of, setting, whole
from mfvpr.utils.numerics import masked

_OUTSIDE = {"unequal": -1000, "zero": 0}


@value
class GridAnchors:
    """Number of pairs (anchor, cell of its patch) that agree, the anchors themselves included.

        mfvpr.GridAnchors(side=26)(mfvpr.match(cells0, cells1, cross_check="candidate"))  # of 26 x 26 cells

    The score counts as the public code does. That code compares flat cell numbers, so that an expected cell may lie at
    the other end of a row, and the padding around the grid takes part. A cell without a match never agrees, not even
    with itself. If a cell has several matches, the match with the lowest query cell counts.

    Attributes:
        side: cells per side of both images; every cell is a keypoint: 40 at 336 px, 26 at 224, 54 at 448.
        patch: n, odd and up to the side (else an InputError); None = 3/4 of the side, rounded down to an odd number.
        outside: value of the padding: "unequal" (-1000) as in the public code on a CPU, which equals no expected cell
            up to a side of 51; or "zero" as in that code on a GPU, where cell 0 of the query may be expected.
    """

    side: int = setting(40, whole(1, 74), "as the features have", unit="cells per side", swept=False, static=True)
    patch: int | None = setting(None, whole(1, 73) | None, "odd; None = 3/4 of the side", unit="cells", static=True)
    outside: str = setting("unequal", one_of("unequal", "zero"), "padding, as its code on a CPU or GPU", static=True)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.size > self.side or self.size % 2 == 0 or self.side * self.size > 2**12:
            limit = "side * patch up to 4096 (float32 holds no larger score exactly)"
            raise InputError(f"patch={self.size}: expected an odd number up to the side of {self.side}, with {limit}")

    @property
    def size(self) -> int:
        """n, cells per side of a patch."""
        if self.patch is not None:
            return self.patch
        size = 3 * self.side // 4
        return max(1, size - (size % 2 == 0))

    def __call__(self, matches: Matches) -> Float[jax.Array, ""]:
        """Score of one pair `[K]`, float32; NaN if there are not side^2 keypoints, or an index is out of range.

        Matches without `index0` or `index1` raise an `InputError`.
        """
        if matches.index0 is None or matches.index1 is None:
            raise InputError("GridAnchors: expected matches with index0 and index1, got none; match all cells")
        real = match_confidence(matches) > 0
        cells = jnp.arange(self.side**2, dtype=jnp.int32)
        cell1, cell0 = (jnp.where(real, jnp.asarray(index, jnp.int32), 0) for index in (matches.index1, matches.index0))
        target = jnp.where(real, cell1, len(cells))  # out of range, hence dropped, unless it is a match
        index = jnp.full(len(cells), len(cells), jnp.int32).at[target].min(cell0, mode="drop")
        matched = index < len(cells)
        side, half = self.side, self.size // 2
        anchors, neighbors = (masked(index, matched, never).reshape(side, side) for never in (2**20, -(2**20)))
        neighbors = jnp.pad(neighbors, half, constant_values=_OUTSIDE[self.outside])

        def count_row(row: Array, counts: Array) -> Array:  # of each patch
            cells = jax.lax.dynamic_slice_in_dim(neighbors, row, side)
            for column in range(self.size):
                expected = anchors + (row - half) * side + column - half
                counts = counts + (cells[:, column : column + side] == expected).astype(jnp.int32)
            return counts

        counts = jax.lax.fori_loop(0, self.size, count_row, jnp.zeros((side, side), jnp.int32))
        score = jnp.sum(counts)
        usable = jnp.all((cell1 >= 0) & (cell1 < len(cells)) & (cell0 >= 0) & (cell0 < len(cells)))
        for count in (matches.count0, matches.count1):
            usable &= count is None or jnp.asarray(count) == len(cells)
        return jnp.where(usable | ~jnp.any(real), score.astype(jnp.float32), jnp.nan)
