"""Recall@K: how many queries have a positive among the first of their ranking."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.positives import Positives
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array


def hits(
    rows: Int[np.ndarray, "*batch queries depth"], positives: Positives, k: int = 1
) -> Bool[np.ndarray, "*batch queries"]:
    """Whether one of the first k database rows of a ranking is a positive; -1 never is."""
    return np.any(positives.contains(rows[..., :k]), axis=-1)


def count_correct(
    rows: Int[np.ndarray, "queries depth"], positives: Positives, ks: Sequence[int]
) -> Int[np.ndarray, " ks"]:
    """Number of queries with a positive among their first k."""
    correct = positives.contains(rows)
    return np.array([correct[:, :k].any(axis=1).sum() for k in ks], int)


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
    order = np.asarray(as_array(order))
    if order.ndim != 2:
        raise InputError(f"order: expected database rows [Q, C], best first, got {list(order.shape)}; count each "
                         "ranking of several by itself")  # fmt: skip
    sets = positives if isinstance(positives, Positives) else Positives.from_matrix(as_array(positives))
    return count_correct(order, sets, ks) / max(len(order), 1)
