"""Matches of queries on disk, one file for each query: see `cache_files`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mfvpr.core.types import Matches
from mfvpr.matchers.match_set import QueryMatches
from mfvpr.storage.cache_files import THREADS, CacheFiles
from mfvpr.storage.packing import pack_matches, unpack_matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.threads import ordered_map


class MatchStore(CacheFiles[QueryMatches]):
    """Matches of `num_queries` queries by row, of a recipe that determines database, queries, shortlist and matcher."""

    def __init__(self, root: Path, recipe: Mapping[str, Any], num_queries: int) -> None:
        # Compressed, since every candidate repeats points of the query: a match takes about 23 bytes instead of 32.
        super().__init__(root, "matches", recipe, pack_matches, unpack_matches, compress=True)
        self.num_queries = num_queries

    def has_all(self, rows: Iterable[int]) -> bool:
        """Whether there are files of all rows."""
        return all(_key(row) in self for row in rows)

    def read(self, rows: Iterable[int]) -> Iterator[tuple[int, QueryMatches | None]]:
        """(row, matches) in the order of rows; None if there is no file, or a damaged one."""
        rows = list(rows)
        yield from zip(rows, ordered_map(lambda row: self.get(_key(row)), rows, workers=THREADS), strict=True)

    def write(self, queries: Mapping[int, QueryMatches]) -> None:
        """Write matches by row; see `CacheFiles.update`."""
        self.update({_key(row): query for row, query in queries.items()})


class StoredMatches(Sequence[Matches]):
    """Matches of queries of a store, as in QueryMatches: every access reads them."""

    def __init__(self, store: MatchStore, rows: Sequence[int]) -> None:
        self._store, self._rows = store, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, query: Any) -> Matches:
        """Matches of one query; slices are not supported."""
        return next(self._read([self._rows[query]]))

    def __iter__(self) -> Iterator[Matches]:
        return self._read(self._rows)

    def _read(self, rows: Sequence[int]) -> Iterator[Matches]:
        for row, query in self._store.read(rows):
            if query is None:
                raise InputError(f"{self._store.folder}: matches of row {row} were removed or damaged; run again")
            yield query.matches


def _key(row: int) -> str:
    return f"{row % 100:02d}{row:06d}"
