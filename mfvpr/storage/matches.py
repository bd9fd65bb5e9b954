"""Matches of all queries with their candidates on disk, read by every sweep of parameters.

    with open_match_store(path, recipe, num_queries=Q, num_candidates=C) as store:
        store.write({row: query_matches})  # batch by batch, the rows that are not done
        for row, query_matches in store.read():
            ...

A row store (`mfvpr.storage.rows`) that gives back the same bits. A row holds the fields of QueryMatches and of its
Matches by name, except fields that are None. Files are compressed, since every candidate repeats points of the query: a
match takes about 23 bytes instead of 32.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.core.types import Matches
from mfvpr.matchers.match_set import QueryMatches
from mfvpr.storage.manifest import MATCHES
from mfvpr.storage.rows import RowFormat, RowStore, row_bytes

_OF_QUERY = ("counts", "indices", "filter_scores")
_OF_MATCHES = tuple(part.name for part in fields(Matches) if part.name != "mask")  # there is no padding
_NUM_ARRAYS = len(_OF_QUERY + _OF_MATCHES)

MatchStore = RowStore[QueryMatches]


def open_match_store(
    folder: Path, recipe: Mapping[str, Any], *, num_queries: int, num_candidates: int, **options: Any
) -> MatchStore:
    """The store in `folder` of the matches of Q queries with C candidates each; see `features.open_store`."""
    sizes = {"num_queries": num_queries, "num_candidates": num_candidates}
    form = RowFormat(MATCHES, partial(_pack, num_candidates), _unpack)
    return RowStore(folder, form, recipe, sizes, **options)


class StoredMatches(Sequence[Matches]):
    """Matches of queries of a store, as in QueryMatches: every access reads them."""

    def __init__(self, store: MatchStore, rows: Sequence[int]) -> None:
        self._store, self._rows = store, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, query: Any) -> Matches:
        """Matches of one query; slices are not supported."""
        [(_, query_matches)] = self._store.read([self._rows[query]])
        return query_matches.matches

    def __iter__(self) -> Iterator[Matches]:
        return (query_matches.matches for _, query_matches in self._store.read(self._rows))


def forecast_bytes(num_queries: int, num_candidates: int, matches_per_candidate: float) -> int:
    """Bytes on disk, at most, of the matches of queries."""
    return num_queries * row_bytes(num_candidates * (40 * matches_per_candidate + 24) + 8, _NUM_ARRAYS)


def _pack(num_candidates: int, query: QueryMatches) -> dict[str, np.ndarray]:
    flat = query.matches
    if not np.all(flat.mask) or np.sum(query.counts) != len(flat.mask):
        raise ValueError("expected real matches, as many as counted")
    if not query.counts.shape == query.indices.shape == query.filter_scores.shape == (num_candidates,):
        raise ValueError(f"expected {num_candidates} candidates")
    parts = {name: getattr(flat, name) for name in _OF_MATCHES} | {name: getattr(query, name) for name in _OF_QUERY}
    return {name: np.asarray(values) for name, values in parts.items() if values is not None}


def _unpack(parts: Mapping[str, np.ndarray]) -> QueryMatches:
    of_matches = {name: values for name, values in parts.items() if name in _OF_MATCHES}
    matches = Matches(mask=np.ones(len(parts["points0"]), bool), **of_matches)
    return QueryMatches(matches, *(parts[name] for name in _OF_QUERY))
