"""Who is whose neighbor on the way through a map: neighbors fail together, which intervals and tests must know."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from mfvpr.datasets.positives import Positives
from mfvpr.datasets.truth import Unit


def places_along_path(shown: Positives, unit: Unit) -> np.ndarray:
    """`[Q]` whole numbers from 0: the places that queries of one or of several drives are at, in the map's order.

    Frames are in order as they are. Positions have names that may be sorted by anything: neighbors are images that a
    query has in common, and each part of the map is walked from one of its ends. Images that are right or not are in
    the order of the first queries that they show. -1 where no image shows the query's place.

    Args:
        shown: images of the map that show each query's place, within a tolerance or a radius.
        unit: of that.
    """
    order = {"frames": _as_it_is, "m": _walked, "exact": _first_queries}[unit](shown)
    sums = np.add.reduceat(np.append(order[shown.rows], 0), shown.offsets[:-1]) if len(shown) else np.zeros(0)
    middle = sums / np.maximum(shown.counts, 1)
    return np.where(shown.counts > 0, np.unique(middle, return_inverse=True)[1], -1)


def _as_it_is(shown: Positives) -> np.ndarray:
    return np.arange(shown.num_database)


def _walked(shown: Positives) -> np.ndarray:
    """`[N]` when each image is met on a walk from an end of its part of the map."""
    queries, size = len(shown), len(shown) + shown.num_database
    pairs = np.repeat(np.arange(queries), shown.counts), queries + shown.rows
    graph = coo_array((np.ones(2 * len(pairs[0])), (np.append(*pairs), np.append(*pairs[::-1]))), shape=(size, size))
    graph = graph.tocsr()
    _, part = connected_components(graph, directed=False)
    rank, met = np.zeros(size, int), 0
    for start in np.unique(part[pairs[1]], return_index=True)[1]:
        end = breadth_first_order(graph, pairs[1][start], return_predecessors=False)[-1]
        order = breadth_first_order(graph, end, return_predecessors=False)
        rank[order] = np.arange(met, met + len(order))
        met += len(order)
    return rank[queries:]


def _first_queries(shown: Positives) -> np.ndarray:
    """`[N]` the first query that each image shows."""
    first = np.full(shown.num_database, len(shown))
    np.minimum.at(first, shown.rows, np.repeat(np.arange(len(shown)), shown.counts))
    return first
