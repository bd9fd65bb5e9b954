"""Recall@K: how many queries have a positive among the first of their ranking."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mfvpr.datasets.positives import Positives


@dataclass(frozen=True)
class Tally:
    """Recall@K as counts, which add up: of shards, of what was done before and after an interruption, of sequences.

    Attributes:
        right: `[len(ks)]` queries that have a positive among their first k.
        queries: all that were asked.
    """

    right: np.ndarray
    queries: int

    @classmethod
    def of(cls, order: Any, positives: Positives | np.ndarray, ks: Sequence[int]) -> "Tally":
        """Of some queries; arguments as of `recall_at_k`."""
        order = np.asarray(order)
        if order.size == 0:
            return cls(np.zeros(len(ks), int), len(order))
        right = (positives if isinstance(positives, Positives) else Positives.from_matrix(positives)).contains(order)
        return cls(np.array([right[:, :k].any(axis=1).sum() for k in ks], int), len(order))

    def merged(self, other: "Tally") -> "Tally":
        """Of both's queries, which are others; the order of merging changes nothing."""
        if len(self.right) != len(other.right):
            raise ValueError(f"expected tallies of the same depths, got {len(self.right)} and {len(other.right)}")
        return Tally(self.right + other.right, self.queries + other.queries)

    @property
    def recall(self) -> np.ndarray:
        """`[len(ks)]` fractions of all queries; 0 without any."""
        return self.right / max(self.queries, 1)


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
    return Tally.of(order, positives, ks).recall
