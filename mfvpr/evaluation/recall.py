"""Recall@K: how many queries have a positive among the first of their ranking."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.positives import Positives
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array


@dataclass(frozen=True)
class Tally:
    """Recall@K as counts, which can be added over shards, sequences and the parts of an interrupted run.

    Attributes:
        correct: number of queries with a positive among their first k.
        queries: number of all queries.
    """

    correct: Int[np.ndarray, " ks"]
    queries: int

    @classmethod
    def of(cls, order: Any, positives: Positives | Bool[Array, "queries database"], ks: Sequence[int]) -> "Tally":
        """Count the queries of a ranking; for the arguments see `recall_at_k`."""
        order = np.asarray(as_array(order))
        if order.ndim != 2:
            raise InputError(f"order: expected database rows [Q, C], best first, got {list(order.shape)}; count each "
                             "ranking of several by itself")  # fmt: skip
        if order.size == 0:
            return cls(np.zeros(len(ks), int), len(order))
        sets = positives if isinstance(positives, Positives) else Positives.from_matrix(np.asarray(as_array(positives)))
        correct = sets.contains(order)
        return cls(np.array([correct[:, :k].any(axis=1).sum() for k in ks], int), len(order))

    def merge(self, other: "Tally") -> "Tally":
        """Add the counts of other queries."""
        if len(self.correct) != len(other.correct):
            raise ValueError(f"expected tallies of the same depths, got {len(self.correct)} and {len(other.correct)}")
        return Tally(self.correct + other.correct, self.queries + other.queries)

    @property
    def recall(self) -> Float[np.ndarray, " ks"]:
        """Fractions of all queries; 0 without queries."""
        return self.correct / max(self.queries, 1)


def hits(
    rows: Int[np.ndarray, "*batch queries depth"], positives: Positives, k: int = 1
) -> Bool[np.ndarray, "*batch queries"]:
    """Whether one of the first k database rows of a ranking is a positive; -1 never is."""
    return np.any(positives.contains(rows[..., :k]), axis=-1)


def recall_at_k(
    order: Any, positives: Positives | Bool[Array, "queries database"], ks: Sequence[int]
) -> Float[np.ndarray, " ks"]:
    """Fraction of ALL queries with a positive among their first k.

    Args:
        order: `[Q, C]` database rows, best first; -1 = none.
        positives: a query without positives counts as a failure.
        ks: depths; beyond C all C candidates count.

    Raises:
        InputError: `order` has other axes.
    """
    return Tally.of(order, positives, ks).recall
