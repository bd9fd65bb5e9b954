"""Matches of all queries with their candidates on disk: matched once, read by every sweep of parameters.

    with open_match_store(path, recipe, num_queries=Q, num_candidates=C) as store:
        store.write({row: query_matches})  # batch by batch, the rows that are not done
        for row, query_matches in store.read():
            ...

A row store (`mfvpr.data.row_store`) that gives back the very same bits. Its arrays are `query` float32 `[Q, 2**30, 3]`
(x, y, score of each match's point in the query), `candidate` float32 `[Q, 2**30, 5]` (x, y, score in the candidate;
distance; ratio), `shortlist` int32 `[Q, 2, C]` (database row, -1 = none; number of matches), `filter_scores` float32
`[Q, C]` and `sizes` float32 `[Q, 1 + C, 2]` (px, the query's first); `count` `[Q]` are the matches of all candidates.

A match takes 18 bytes of the 32 that it has: what it says of the query comes again with every candidate, which zstd
sees where whole points follow each other in one large chunk; all else is noise but for the exponents, which a shuffle
of the bytes brings together.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.data import row_store
from mfvpr.data._store_disk import BYTES, Column
from mfvpr.data.row_store import RowStore, open_rows
from mfvpr.data.store_manifest import MATCHES
from mfvpr.types import Matches

CHUNK_ROWS = 2**14  # matches
MAX_MATCHES = 2**30  # of one query
_REPEATING = (BYTES, {"name": "zstd", "configuration": {"level": 9}})
_NOISE = (
    {"name": "transpose", "configuration": {"order": [0, 2, 1]}},
    BYTES,
    {
        "name": "blosc",
        "configuration": {"cname": "zstd", "clevel": 5, "shuffle": "shuffle", "typesize": 4, "blocksize": 0},
    },
)


@dataclass(frozen=True)
class QueryMatches:
    """All of one query: its candidates, and their real matches one after the other. NumPy.

    Attributes:
        matches: Matches `[n, ...]` of all candidates, best candidate first, with their ratio, and without padding;
            `image_size0` `[2]`, `image_size1` `[C, 2]`.
        counts: `[C]` int32 matches of each candidate; their sum is n.
        indices: `[C]` int32 database rows, best first, -1 = none.
        filter_scores: `[C]` float32.
    """

    matches: Matches
    counts: np.ndarray
    indices: np.ndarray
    filter_scores: np.ndarray


@dataclass(eq=False)
class MatchStore:
    """An open store; made by `open_match_store`.

    Attributes:
        num_candidates: C.
    """

    num_candidates: int
    _rows: RowStore = field(repr=False)

    @property
    def folder(self) -> Path:
        """Where it is, absolute."""
        return self._rows.folder

    @property
    def done(self) -> np.ndarray:
        """`[Q]` bool, the queries whose matches are on disk."""
        return self._rows.done

    @property
    def size_bytes(self) -> int:
        """Bytes that the store takes on disk."""
        return self._rows.size_bytes

    def write(self, found: Mapping[int, QueryMatches]) -> None:
        """Store the matches of a batch of queries. When this returns they are done, and on disk.

        Args:
            found: all of a query, by row.

        Raises:
            InputError: the disk is full, or cannot be written. Rows done before stay intact.
            ValueError: a row that is done or does not exist, padding, no ratio, or another number of candidates.
        """
        columns = _columns(self.num_candidates)
        self._rows.write({row: self._parts(row, query) for row, query in found.items()}, columns)

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, QueryMatches]]:
        """(row, all of a query) of queries that are done, by default of all; some are read ahead on threads.

        Raises:
            InputError: some were damaged on disk, told after the others were given; they are no longer done, so that
                the next run matches them anew. Or the disk cannot be read.
            ValueError: a row that is not done.
        """
        for row, parts in self._rows.read(rows):
            yield row, _query_matches(parts)

    def _parts(self, row: int, query: QueryMatches) -> dict[str, np.ndarray]:
        """What is stored of a query, by array."""
        flat, candidates = query.matches, (self.num_candidates,)
        if flat.ratio is None or not np.all(flat.mask) or np.sum(query.counts) != len(flat.mask):
            raise ValueError(f"{self.folder}: row {row}: expected real matches with their ratio, as many as counted")
        if not query.counts.shape == query.indices.shape == query.filter_scores.shape == candidates:
            raise ValueError(f"{self.folder}: row {row}: expected {self.num_candidates} candidates")
        return {
            "query": np.column_stack([flat.points0, flat.scores0]),
            "candidate": np.column_stack([flat.points1, flat.scores1, flat.distance, flat.ratio]),
            "shortlist": np.stack([query.indices, query.counts]),
            "filter_scores": query.filter_scores,
            "sizes": np.concatenate([flat.image_size0[None], flat.image_size1]),
        }


@contextmanager
def open_match_store(
    folder: Path,
    recipe: Mapping[str, Any],
    *,
    num_queries: int,
    num_candidates: int,
    waiting: Callable[[str], None] | None = None,
) -> Iterator[MatchStore]:
    """The store in `folder`, made if it is not there; no other process can open it meanwhile.

    Args:
        folder: see `store_manifest.store_path`, with the kind `MATCHES`.
        recipe: what the matches are made from (JSON values only): features, shortlist, settings. Kept in plain text.
        num_queries: Q.
        num_candidates: C.
        waiting: is told, in one line, which process this waits for; None = refuse a store that is in use.

    Raises:
        InputError: made from something else, in use, damaged beyond what the next run mends by itself, no store at
            all, or the folder cannot be written.
    """
    sizes = {"num_queries": num_queries, "num_candidates": num_candidates}
    with open_rows(folder, MATCHES, recipe, sizes, waiting) as rows:
        rows.resume(_columns(num_candidates))
        yield MatchStore(num_candidates, rows)


def forecast_bytes(num_queries: int, num_candidates: int, matches_per_candidate: float) -> int:
    """Bytes on disk that queries with so many matches take at most."""
    return row_store.forecast_bytes(_columns(num_candidates), num_queries, num_candidates * matches_per_candidate)


def _columns(num_candidates: int) -> dict[str, Column]:
    return {
        "query": Column("float32", (3,), CHUNK_ROWS, MAX_MATCHES, _REPEATING),
        "candidate": Column("float32", (5,), CHUNK_ROWS, MAX_MATCHES, _NOISE),
        "shortlist": Column("int32", (2, num_candidates)),
        "filter_scores": Column("float32", (num_candidates,)),
        "sizes": Column("float32", (1 + num_candidates, 2)),
    }


def _query_matches(parts: Mapping[str, np.ndarray]) -> QueryMatches:
    query, candidate, sizes = parts["query"], parts["candidate"], parts["sizes"]
    indices, counts = parts["shortlist"]
    matches = Matches(
        points0=query[:, :2],
        points1=candidate[:, :2],
        distance=candidate[:, 3],
        scores0=query[:, 2],
        scores1=candidate[:, 2],
        mask=np.ones(len(query), bool),
        image_size0=sizes[0],
        image_size1=sizes[1:],
        ratio=candidate[:, 4],
    )
    return QueryMatches(matches, counts, indices, parts["filter_scores"])
