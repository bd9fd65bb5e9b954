"""Recall@K of rankings."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array


@runtime_checkable
class Positives(Protocol):
    """Correct database rows of each query, such as `mfvpr.datasets.Positives`."""

    def contains(self, rows: Any) -> Bool[np.ndarray, "*batch queries k"]:
        """Whether rows `[..., Q, k]` of rankings are positives of their query; -1 never is."""
        ...


def hits(
    rows: Int[np.ndarray, "*batch queries depth"], positives: Positives, k: int = 1
) -> Bool[np.ndarray, "*batch queries"]:
    """Whether one of the first k database rows of a ranking is a positive; -1 never is."""
    return np.any(positives.contains(rows[..., :k]), axis=-1)


def recall_at_k(
    order: Any, positives: Positives | Bool[Array, "queries database"], ks: Sequence[int]
) -> Float[np.ndarray, " ks"]:
    """Fraction of ALL queries with a positive among their first k.

        mfvpr.recall_at_k([[0, 1], [2, 1]], np.eye(2, 3, dtype=bool), ks=[1, 2])  # [0.5, 1.0]

    Args:
        order: `[Q, C]` database rows, best first; -1 = none.
        positives: a query without positives counts as a failure.
        ks: depths from 1; beyond C all C candidates count.

    Raises:
        InputError: `order` has other axes, a depth is below 1, or `positives` are of other queries or fewer rows.
    """
    order = np.asarray(as_array(order))
    if order.ndim != 2:
        got = f"{list(order.shape)}; count each ranking of several by itself"
        raise InputError(f"order: expected database rows [Q, C], best first, got {got}")
    if min(ks, default=1) < 1:
        raise InputError(f"ks: expected depths from 1, got {min(ks)}")
    sets = positives if isinstance(positives, Positives) else _Matrix(np.asarray(as_array(positives)))
    return np.array([hits(order, sets, k).sum() for k in ks], int) / max(len(order), 1)


class _Matrix:
    """Positives as a matrix `[Q, N]` bool."""

    def __init__(self, matrix: np.ndarray) -> None:
        if matrix.ndim != 2:
            raise InputError(f"positives: expected a matrix [queries, database], got shape {matrix.shape}")
        if not np.isin(matrix, (0, 1)).all():
            raise InputError("positives: expected True and False for each database row, got other values, such as rows")
        self.matrix = matrix.astype(bool)

    def contains(self, rows: np.ndarray) -> Bool[np.ndarray, "queries k"]:
        """See `Positives`."""
        queries, size = self.matrix.shape
        if len(rows) != queries or (rows.size and (rows.dtype.kind not in "iu" or rows.max() >= size)):
            raise InputError(f"order: expected rows below {size} of {queries} queries, got {rows.dtype}{rows.shape}")
        if not size:
            return np.zeros(rows.shape, bool)
        return np.take_along_axis(self.matrix, np.maximum(rows, 0).astype(int), axis=1) & (rows >= 0)
