"""Which database images are right for each query, as rows per query. Host-side NumPy: nothing is worth a device."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from mfvpr.utils.errors import InputError

_AT_A_TIME = 1 << 20  # ranked rows and positives that are looked up at once, in numbers of eight bytes
_QUERIES_AT_A_TIME = 128  # of a search by radius, whose results are Python's lists before they are arrays


@dataclass(frozen=True, eq=False)
class Positives:
    """The database rows that each query has, ragged: memory grows with their number and never with Q x N.

    `from_rows` and `from_matrix` make them. `first | second` and `first - second` are union and difference, query by
    query.

    Attributes:
        rows: `[P]` int32, the rows of all queries one after the other; ascending, none twice in one query.
        offsets: `[Q + 1]` int64; query q has `rows[offsets[q] : offsets[q + 1]]`.
        num_database: N.

    Raises:
        InputError: rows and offsets that are not as above.
    """

    rows: np.ndarray
    offsets: np.ndarray
    num_database: int

    def __post_init__(self) -> None:
        rows, offsets, last = self.rows, self.offsets, self.num_database - 1
        is_there = not len(rows) or 0 <= rows.min() <= rows.max() <= last
        if [*offsets[[0, -1]]] != [0, len(rows)] or (np.diff(offsets) < 0).any() or not is_there:
            raise InputError(f"positives: expected rows from 0 to {last}, and offsets that grow from 0 to {len(rows)}")
        if not _ascending(rows, offsets):
            raise InputError("positives: expected rows that ascend for each query; from_rows takes them in any order")

    @classmethod
    def from_rows(cls, rows: Iterable[Sequence[int] | np.ndarray], num_database: int) -> "Positives":
        """From the rows of each query, in any order.

        Raises:
            InputError: a row that is none of the database, or no whole number.
        """
        per_query = [np.asarray(some) for some in rows]
        flat = np.concatenate([some for some in per_query if len(some)] or [np.zeros(0, np.int32)])
        if flat.dtype.kind not in "iu":
            raise InputError(f"positives: expected rows as whole numbers, got {flat.dtype}; from_matrix takes matrices")
        if flat.size and not 0 <= flat.min() <= flat.max() < num_database:
            raise InputError(f"positives: expected rows of a database of {num_database} images, got {flat.min()} to "
                             f"{flat.max()}; check the ground truth")  # fmt: skip
        flat, offsets = flat.astype(np.int32, copy=False), _offsets(list(map(len, per_query)))
        if _ascending(flat, offsets):
            return cls(flat, offsets, num_database)
        none = cls(flat[:0], np.zeros_like(offsets), num_database)
        return none._with(_distinct(_keys(flat, offsets, num_database)))

    @classmethod
    def from_matrix(cls, matrix: Any) -> "Positives":
        """From `[Q, N]` bool."""
        matrix = np.asarray(matrix, bool)
        if matrix.ndim != 2:
            raise InputError(f"positives: expected a matrix [queries, database], got shape {matrix.shape}")
        return cls.from_rows((np.flatnonzero(right).astype(np.int32) for right in matrix), matrix.shape[1])

    def __len__(self) -> int:
        """Q."""
        return len(self.offsets) - 1

    @property
    def counts(self) -> np.ndarray:
        """`[Q]` how many each query has."""
        return np.diff(self.offsets)

    def any(self) -> bool:
        """Whether any query has any."""
        return len(self.rows) > 0

    def of(self, query: int) -> np.ndarray:
        """`[n]` the rows of one query, ascending."""
        query = range(len(self))[query]
        return self.rows[self.offsets[query] : self.offsets[query + 1]]

    def union(self) -> np.ndarray:
        """`[N]` bool, the rows that at least one query has."""
        union = np.zeros(self.num_database, bool)
        union[self.rows] = True
        return union

    def take(self, queries: Any) -> "Positives":
        """Of some queries: numbers `[q]` in any order, a mask `[Q]`, or a slice."""
        queries = np.arange(len(self))[queries]
        counts = self.counts[queries]
        offsets = _offsets(counts)
        kept = np.repeat(self.offsets[queries] - offsets[:-1], counts) + np.arange(offsets[-1])
        return Positives(self.rows[kept], offsets, self.num_database)

    def among(self, allowed: np.ndarray) -> "Positives":
        """Those that are among database rows `[N]` bool."""
        if np.shape(allowed) != (self.num_database,):
            raise InputError(f"allowed: expected shape ({self.num_database},), got {np.shape(allowed)}")
        kept = np.asarray(allowed, bool)[self.rows]
        return Positives(self.rows[kept], _offsets(kept)[self.offsets], self.num_database)

    def contains(self, rows: Any) -> np.ndarray:
        """Which of some database rows are right, bool; -1 never is.

        Args:
            rows: `[..., Q, k]`, of each query; several rankings may lie on the leading axes.

        Raises:
            InputError: another number of queries, or rows beyond the database.
        """
        rows = np.asarray(rows)
        if rows.ndim < 2 or rows.shape[-2] != len(self):
            raise InputError(f"rows: expected shape [..., {len(self)} queries, k], got {list(rows.shape)}")
        right = np.zeros(rows.shape, bool)
        if not rows.size:
            return right
        if rows.dtype.kind not in "iu" or rows.max() >= self.num_database:
            raise InputError(f"rows: expected whole numbers below {self.num_database}, got {rows.dtype} up to "
                             f"{rows.max()}; rank images of this database")  # fmt: skip
        for first, last in pairwise(self._cuts(rows.size // len(self))):
            block, some = self.take(slice(first, last)), rows[..., first:last, :]
            keys = np.append(block._keys(), -1)  # what lies beyond the last key is not there
            asked = np.arange(last - first)[:, None] * self.num_database + some.astype(np.int64)
            right[..., first:last, :] = (keys[np.searchsorted(keys[:-1], asked)] == asked) & (some >= 0)
        return right

    def dense(self, queries: Any = slice(None)) -> np.ndarray:
        """`[q, N]` bool of some queries, as `take` has them; of all it is what this class is there to avoid."""
        part = self.take(queries)
        dense = np.zeros((len(part), self.num_database), bool)
        for query, right in enumerate(dense):
            right[part.of(query)] = True
        return dense

    def __or__(self, other: "Positives") -> "Positives":
        return self._with(_distinct(np.concatenate(self._both(other))))

    def __sub__(self, other: "Positives") -> "Positives":
        return self._with(np.setdiff1d(*self._both(other), assume_unique=True))

    def _both(self, other: "Positives") -> tuple[np.ndarray, np.ndarray]:
        sizes = [(len(one), one.num_database) for one in (self, other)]
        if sizes[0] != sizes[1]:
            raise InputError(f"positives: expected two of one size (queries, database), got {sizes[0]} and {sizes[1]}")
        return self._keys(), other._keys()

    def _keys(self) -> np.ndarray:
        return _keys(self.rows, self.offsets, self.num_database)

    def _with(self, keys: np.ndarray) -> "Positives":
        """Of the same queries and database, by ascending keys."""
        offsets = np.searchsorted(keys, np.arange(len(self) + 1) * self.num_database)
        rows = keys - np.repeat(np.arange(len(self)) * self.num_database, np.diff(offsets))
        return Positives(rows.astype(np.int32), offsets, self.num_database)

    def _cuts(self, ranked: int) -> np.ndarray:
        """Where to cut the queries, each with so many ranked rows beside its own, so that a part is of bounded size."""
        sizes = self.offsets + np.arange(len(self) + 1) * ranked
        ends = np.arange(0, sizes[-1] + _AT_A_TIME, _AT_A_TIME)
        return np.unique(np.minimum(np.searchsorted(sizes, ends), len(self)))


def side_by_side(parts: Sequence[Positives]) -> Positives:
    """Of all queries and databases, one behind the other."""
    starts = np.cumsum([0, *(part.num_database for part in parts)])
    rows = np.concatenate([part.rows + int(start) for part, start in zip(parts, starts[:-1], strict=True)])
    return Positives(rows.astype(np.int32), _offsets(np.concatenate([part.counts for part in parts])), int(starts[-1]))


def stacked(parts: Sequence[Positives]) -> Positives:
    """Of all queries, one behind the other, of the same database."""
    rows = np.concatenate([part.rows for part in parts])
    return Positives(rows, _offsets(np.concatenate([part.counts for part in parts])), parts[0].num_database)


def rows_within(query_xy: np.ndarray, database_xy: np.ndarray, radius: float) -> Iterator[np.ndarray]:
    """For each query `[n]` int32, the database rows at most `radius` meters away; as `radius_positives`."""
    query_xy, database_xy = np.asarray(query_xy, np.float64), np.asarray(database_xy, np.float64)
    if not len(database_xy):
        yield from (np.zeros(0, np.int32) for _ in query_xy)
        return
    tree = KDTree(database_xy)
    for first in range(0, len(query_xy), _QUERIES_AT_A_TIME):
        some = query_xy[first : first + _QUERIES_AT_A_TIME]
        for rows in tree.query_ball_point(some, radius, return_sorted=True):
            yield np.array(rows, np.int32)


def frame_positives(query_index: np.ndarray, database_index: np.ndarray, *, tolerance: int) -> np.ndarray:
    """`[Q, N]` bool: |database_index - query_index| <= tolerance, inclusive.

    Args:
        query_index: `[Q]` frame number of each query's true place; negative = unknown, no positives.
        database_index: `[N]` frame number of each database image.
        tolerance: in frames.
    """
    query_index, database_index = np.asarray(query_index, np.int64), np.asarray(database_index, np.int64)
    positives = np.zeros((len(query_index), len(database_index)), bool)
    for row in np.flatnonzero(query_index >= 0):  # row by row: numbers take eight times the memory of bool
        np.less_equal(np.abs(database_index - query_index[row]), tolerance, out=positives[row])
    return positives


def radius_positives(query_xy: np.ndarray, database_xy: np.ndarray, *, radius: float = 25.0) -> np.ndarray:
    """`[Q, N]` bool: at most `radius` meters apart, inclusive. Coordinates `[Q, 2]`, `[N, 2]` are UTM, float64."""
    positives = np.zeros((len(query_xy), len(database_xy)), bool)
    for right, rows in zip(positives, rows_within(query_xy, database_xy, radius), strict=True):
        right[rows] = True
    return positives


def _ascending(rows: np.ndarray, offsets: np.ndarray) -> bool:
    """Whether the rows of each query ascend, none twice."""
    ascending = rows[1:] > rows[:-1]
    starts = offsets[(offsets > 0) & (offsets < len(rows))]  # of another query: its rows begin anew
    ascending[starts - 1] = True
    return bool(ascending.all())


def _keys(rows: np.ndarray, offsets: np.ndarray, num_database: int) -> np.ndarray:
    """`[P]` int64, query x N + row: ascending if the rows of each query are, and a set of them is one of pairs."""
    return np.repeat(np.arange(len(offsets) - 1) * num_database, np.diff(offsets)) + rows


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Ascending, none twice. `np.unique` hashes, which takes a hundred times as long on keys that nearly ascend."""
    keys = np.sort(keys, kind="stable")
    return keys[np.diff(keys, prepend=-1) > 0]


def _offsets(counts: Any) -> np.ndarray:
    """`[n + 1]` int64, where each of n runs of so many begins, and the end."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
