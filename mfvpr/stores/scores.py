"""Scores of all queries' candidates on disk, of shards: computed once, read by whichever comes last.

A row store (`mfvpr.stores.rows`), whose rows are the `scores` float32 `[S, C]` of a query's candidates by S scorers, to
the bit.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.stores.manifest import SCORES
from mfvpr.stores.rows import RowStore, open_rows

ScoreStore = RowStore[np.ndarray]


def open_score_store(folder: Path, recipe: Mapping[str, Any], *, num_queries: int, **options: Any) -> ScoreStore:
    """The store in `folder`; see `features.open_store`."""
    return open_rows(folder, SCORES, recipe, {"num_queries": num_queries}, pack=_pack, unpack=_unpack, **options)


def _pack(scores: np.ndarray) -> dict[str, np.ndarray]:
    return {"scores": np.asarray(scores, np.float32)}


def _unpack(parts: Mapping[str, np.ndarray]) -> np.ndarray:
    return parts["scores"]
