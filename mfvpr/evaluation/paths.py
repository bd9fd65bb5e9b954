"""The order of places along a path. Neighbors fail together, which confidence intervals and tests must consider."""

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from mfvpr.datasets.positives import Positives
from mfvpr.datasets.truth import Unit


def places_along_path(shown: Positives, unit: Unit) -> Int[np.ndarray, " queries"]:
    """Places of the queries of one or several drives: whole numbers from 0 in the order of the map.

    Frames of the map are in the order of their rows. Images with positions may have any order: two images are neighbors
    if they show the place of the same query, and each connected part of the map is traversed from one of its ends. With
    the unit "exact", images are in the order of the first queries that they show.

    Args:
        shown: images of the map that show each query's place, within a tolerance or a radius.
        unit: of the tolerance or radius.

    Returns:
        -1 for a query whose place no image shows.
    """
    order = {"frames": _row_order, "m": _traversal_order, "exact": _query_order}[unit](shown)
    sums = np.add.reduceat(np.append(order[shown.rows], 0), shown.offsets[:-1]) if len(shown) else np.zeros(0)
    middle = sums / np.maximum(shown.counts, 1)
    return np.where(shown.counts > 0, np.unique(middle, return_inverse=True)[1], -1)


def _row_order(shown: Positives) -> np.ndarray:
    return np.arange(shown.num_database)


def _traversal_order(shown: Positives) -> np.ndarray:
    """Position `[N]` of each image in a traversal of its connected part of the map from an end."""
    queries, size = len(shown), len(shown) + shown.num_database
    pairs = np.repeat(np.arange(queries), shown.counts), queries + shown.rows
    graph = coo_array((np.ones(2 * len(pairs[0])), (np.append(*pairs), np.append(*pairs[::-1]))), shape=(size, size))
    graph = graph.tocsr()
    _, part = connected_components(graph, directed=False)
    rank, visited = np.zeros(size, int), 0
    for start in np.unique(part[pairs[1]], return_index=True)[1]:
        end = breadth_first_order(graph, pairs[1][start], return_predecessors=False)[-1]
        order = breadth_first_order(graph, end, return_predecessors=False)
        rank[order] = np.arange(visited, visited + len(order))
        visited += len(order)
    return rank[queries:]


def _query_order(shown: Positives) -> np.ndarray:
    """The first query `[N]` whose place each image shows."""
    first = np.full(shown.num_database, len(shown))
    np.minimum.at(first, shown.rows, np.repeat(np.arange(len(shown)), shown.counts))
    return first
