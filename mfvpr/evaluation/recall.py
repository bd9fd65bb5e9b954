"""Recall@K: how many queries have a positive among the first of their ranking."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mfvpr.evaluation.positives import Positives


def hits(rows: np.ndarray, positives: Positives, k: int = 1) -> np.ndarray:
    """`[..., Q]` bool, whether one of the first k `rows` `[..., Q, depth]` is right; -1 never is."""
    return np.any(positives.contains(rows[..., :k]), axis=-1)


def recall_at_k(order: Any, positives: Positives | np.ndarray, ks: Sequence[int]) -> np.ndarray:
    """`[len(ks)]` fraction of ALL queries that have a positive among their first k.

    Args:
        order: `[Q, C]` database rows, best first; -1 = none.
        positives: `Positives`, or `[Q, N]` bool. A query without positives counts as a failure.
        ks: depths; beyond C all C candidates count.
    """
    order = np.asarray(order)
    if order.size == 0:
        return np.zeros(len(ks))
    right = (positives if isinstance(positives, Positives) else Positives.from_matrix(positives)).contains(order)
    return np.array([right[:, :k].any(axis=1).mean() for k in ks])
