"""Which database images are right, and recall@K. Host-side NumPy: nothing here is worth a device."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree


def frame_positives(query_index: np.ndarray, database_index: np.ndarray, *, tolerance: int) -> np.ndarray:
    """`[Q, N]` bool: |database_index - query_index| <= tolerance, inclusive.

    Args:
        query_index: `[Q]` frame number of each query's true place; negative = unknown, no positives.
        database_index: `[N]` frame number of each database image.
        tolerance: in frames.
    """
    query_index, database_index = np.asarray(query_index, np.int64), np.asarray(database_index, np.int64)
    positives = np.zeros((len(query_index), len(database_index)), bool)
    for row in np.flatnonzero(query_index >= 0):  # row by row: numbers take eight times the memory of bool
        np.less_equal(np.abs(database_index - query_index[row]), tolerance, out=positives[row])
    return positives


def radius_positives(query_xy: np.ndarray, database_xy: np.ndarray, *, radius: float = 25.0) -> np.ndarray:
    """`[Q, N]` bool: at most `radius` meters apart, inclusive. Coordinates `[Q, 2]`, `[N, 2]` are UTM, float64."""
    query_xy, database_xy = np.asarray(query_xy, np.float64), np.asarray(database_xy, np.float64)
    positives = np.zeros((len(query_xy), len(database_xy)), bool)
    if positives.size:
        tree = KDTree(database_xy)
        for row, xy in zip(positives, query_xy, strict=True):
            # One by one: the lists of all neighbors would take eight times the memory of `positives`.
            row[tree.query_ball_point(xy, radius)] = True
    return positives


def recall_at_k(order: np.ndarray, positives: np.ndarray, ks: Sequence[int]) -> np.ndarray:
    """`[len(ks)]` fraction of ALL queries that have a positive among their first k.

    Args:
        order: `[Q, C]` database rows, best first; -1 = none.
        positives: `[Q, N]` bool. A query without positives counts as a failure.
        ks: depths; beyond C all C candidates count.
    """
    order = np.asarray(order)
    if order.size == 0 or np.size(positives) == 0:
        return np.zeros(len(ks))
    hits = np.take_along_axis(np.asarray(positives), np.maximum(order, 0), axis=1) & (order >= 0)
    return np.array([hits[:, :k].any(axis=1).mean() for k in ks])
