"""Correct database images of each query, as rows per query, in NumPy on the host."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its subpackages take 0.2 s, and are imported at their first use
from jaxtyping import Bool, Float64, Int, Integer, Num

from mfvpr.utils.errors import InputError

FARTHEST = 1e9  # meters; beyond, distances are not exact to a centimeter
_BLOCK = 1024  # queries whose pairs are searched together: a pair takes five times as much memory as its result


@dataclass(frozen=True, eq=False)
class Positives:
    """Ragged lists of database rows, one per query; memory grows with the number of rows, not with Q x N.

        positives = mfvpr.datasets.Positives.from_rows([[0, 1], [], [2]], num_database=4)
        positives.of(0)  # [0, 1]

    `first | second` and `first - second` go query by query.

    Attributes:
        matrix: `[Q, N]` bool, given dense or sparse; kept sparse, in SciPy's canonical form.
    """

    matrix: "scipy.sparse.csr_array"

    def __post_init__(self) -> None:
        if np.ndim(self.matrix) != 2:
            raise InputError(f"positives: expected a matrix [Q, N], got shape {np.shape(self.matrix)}; see from_rows")
        matrix = scipy.sparse.csr_array(self.matrix, dtype=bool)
        if not matrix.has_canonical_format or not matrix.data.all():
            matrix = matrix.copy()  # of the caller, perhaps
            matrix.sum_duplicates()  # and sort each query's rows
            matrix.eliminate_zeros()
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_rows(cls, rows: Iterable[Sequence[int] | np.ndarray], num_database: int) -> "Positives":
        """Create from the rows of each query, in any order; an `InputError` unless they are rows of the database."""
        per_query = [np.asarray(query_rows) for query_rows in rows]
        flat = np.concatenate([query_rows for query_rows in per_query if len(query_rows)] or [np.zeros(0, np.int32)])
        if flat.dtype.kind not in "iu" or (flat.size and not 0 <= flat.min() <= flat.max() < num_database):
            got = f"{flat.dtype} from {flat.min()} to {flat.max()}; Positives(...) takes matrices"
            raise InputError(f"positives: expected rows of a database of {num_database} images, got {got}")
        offsets = np.cumsum([0, *map(len, per_query)], dtype=np.int32 if len(flat) < 2**31 else np.int64)
        content = np.ones(len(flat), bool), flat.astype(np.int32, copy=False), offsets
        return cls(scipy.sparse.csr_array(content, shape=(len(per_query), num_database)))

    @property
    def recipe(self) -> dict[str, Any]:
        """What determines the positives, see `mfvpr.utils.recipe_of`."""
        return {"rows": self.rows, "offsets": self.offsets, "num_database": self.num_database}

    @property
    def rows(self) -> Int[np.ndarray, " _"]:
        """Rows of all queries one after the other; ascending and distinct for each query. int32."""
        return self.matrix.indices.astype(np.int32, copy=False)

    @property
    def offsets(self) -> Int[np.ndarray, " _"]:
        """`[Q + 1]` int64; query q has `rows[offsets[q] : offsets[q + 1]]`."""
        return self.matrix.indptr.astype(np.int64, copy=False)

    @property
    def num_database(self) -> int:
        """N."""
        return self.matrix.shape[1]

    def __len__(self) -> int:
        """Number Q of queries."""
        return self.matrix.shape[0]

    @property
    def counts(self) -> Int[np.ndarray, " queries"]:
        """Number of rows of each query."""
        return np.diff(self.offsets)

    def of(self, query: int) -> Int[np.ndarray, " _"]:
        """Rows of one query, ascending."""
        query = range(len(self))[query]
        first, last = self.matrix.indptr[query : query + 2]
        return self.matrix.indices[first:last].astype(np.int32, copy=False)

    def take(self, queries: Any) -> "Positives":
        """Select queries by numbers `[q]` in any order, a mask `[Q]`, or a slice."""
        return Positives(self.matrix[np.arange(len(self))[queries]])

    def contains(self, rows: Any) -> Bool[np.ndarray, "*batch queries k"]:
        """Whether rankings are correct: whether each of `rows` `[..., Q, k]` is among the query's rows; -1 never is.

        An `InputError` for another number of queries, or rows beyond the database.
        """
        rows = np.asarray(rows)
        is_valid = rows.ndim >= 2 and rows.shape[-2] == len(self)
        if not is_valid or (rows.size and (rows.dtype.kind not in "iu" or rows.max() >= self.num_database)):
            expected = f"whole numbers [..., {len(self)} queries, k] below {self.num_database}"
            got = f"{rows.dtype}{[*rows.shape]} up to {rows.max(initial=-1)}; rank images of this database"
            raise InputError(f"rows: expected {expected}, got {got}")
        if not rows.size or not self.num_database:
            return np.zeros(rows.shape, bool)
        queries = np.broadcast_to(np.arange(len(self))[:, None], rows.shape)
        is_correct = self.matrix[queries.ravel(), np.maximum(rows, 0).ravel()].reshape(rows.shape)
        return np.asarray(is_correct) & (rows >= 0)

    def dense(self, queries: Any = slice(None)) -> Bool[np.ndarray, "_ database"]:
        """Matrix `[q, N]` of queries that are selected as in `take`; large data sets do not fit into memory."""
        return self.take(queries).matrix.toarray()

    def __or__(self, other: "Positives") -> "Positives":
        return Positives(self.matrix + other.matrix)

    def __sub__(self, other: "Positives") -> "Positives":
        return Positives(self.matrix > other.matrix)


def join_positives(parts: Sequence[Positives]) -> Positives:
    """Concatenate queries and databases of independent data sets."""
    return Positives(scipy.sparse.block_diag([part.matrix for part in parts], format="csr"))


def stack_positives(parts: Sequence[Positives]) -> Positives:
    """Concatenate queries of the same database."""
    return Positives(scipy.sparse.vstack([part.matrix for part in parts], format="csr"))


def require_positions(where: str, xy: Any, count: int | None = None) -> Float64[np.ndarray, "images 2"]:
    """Positions in meters as float64, which has no overflow; an InputError unless all of `count` images have one."""
    xy = np.asarray(xy)
    is_number, count = xy.dtype.kind in "iuf", len(xy) if count is None else count
    positions = xy.astype(np.float64) if is_number else np.full(xy.shape, np.nan)
    if xy.shape != (count, 2) or not (np.abs(positions) <= FARTHEST).all():  # NaN neither
        expected = f"positions [{count}, 2] of all images, at most {FARTHEST:g} m"
        got = f"{xy.dtype}{[*xy.shape]} up to {np.abs(positions).max(initial=0):g} m; remove images without a position"
        raise InputError(f"{where}: expected {expected}, got {got}")
    return positions


def positives_within(query_xy: np.ndarray, database_xy: np.ndarray, radius: float) -> Positives:
    """Database images at most `radius` meters away from each query; coordinates as in `radius_positives`."""
    queries, parts = require_positions("query_xy", query_xy), []
    database = scipy.spatial.KDTree(require_positions("database_xy", database_xy))
    for start in range(0, max(1, len(queries)), _BLOCK):
        block = scipy.spatial.KDTree(queries[start : start + _BLOCK])
        pairs = block.sparse_distance_matrix(database, radius, output_type="ndarray")
        content = np.ones(len(pairs), bool), (pairs["i"], pairs["j"])
        parts.append(Positives(scipy.sparse.csr_array(content, shape=(block.n, database.n))))
    return stack_positives(parts)


def frame_positives(
    query_index: Integer[np.ndarray, " queries"], database_index: Integer[np.ndarray, " database"], *, tolerance: int
) -> Bool[np.ndarray, "queries database"]:
    """Positives by frame: |database_index - query_index| <= tolerance.

        mfvpr.frame_positives(np.arange(100), np.arange(100), tolerance=2)  # [Q, N]

    Args:
        query_index: frame number of each query's place; negative = unknown, no positives.
        database_index: frame number of each database image.
        tolerance: in frames.
    """
    query_index, database_index = np.asarray(query_index, np.int64), np.asarray(database_index, np.int64)
    positives = np.zeros((len(query_index), len(database_index)), bool)
    for row in np.flatnonzero(query_index >= 0):  # row by row: numbers take eight times the memory of bool
        np.less_equal(np.abs(database_index - query_index[row]), tolerance, out=positives[row])
    return positives


def radius_positives(
    query_xy: Num[np.ndarray, "queries 2"], database_xy: Num[np.ndarray, "database 2"], *, radius: float = 25.0
) -> Bool[np.ndarray, "queries database"]:
    """Positives by position: at most `radius` meters apart. Coordinates are UTM, finite, of any type of numbers.

    Example:
        query_xy, database_xy = np.array([[0.0, 1.0]]), np.array([[0.0, 0.0], [0.0, 40.0]])
        mfvpr.radius_positives(query_xy, database_xy, radius=25.0)  # [[True, False]]
    """
    return positives_within(query_xy, database_xy, radius).dense()
