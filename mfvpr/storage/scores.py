"""Scores of all queries' candidates on disk: shards compute them, the last shard reads them all.

A row store (`mfvpr.storage.rows`). A row holds the `scores` float32 `[S, C]` of a query's candidates by S scorers, to
the bit, and the `indices` int32 `[C]` of the candidates.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mfvpr.storage.manifest import SCORES
from mfvpr.storage.rows import RowStore


class QueryScores(NamedTuple):
    """The scores and candidates of one query."""

    scores: Float[np.ndarray, "scorers candidates"]
    indices: Int[np.ndarray, " candidates"]


ScoreStore = RowStore[QueryScores]


def open_score_store(folder: Path, recipe: Mapping[str, Any], *, num_queries: int, **options: Any) -> ScoreStore:
    """The store in `folder`; see `features.open_store`."""
    return RowStore(folder, SCORES, recipe, {"num_queries": num_queries}, pack=_pack, unpack=_unpack, **options)


def _pack(query: QueryScores) -> dict[str, np.ndarray]:
    return {"scores": np.asarray(query.scores, np.float32), "indices": np.asarray(query.indices, np.int32)}


def _unpack(parts: Mapping[str, np.ndarray]) -> QueryScores:
    return QueryScores(parts["scores"], parts["indices"])
