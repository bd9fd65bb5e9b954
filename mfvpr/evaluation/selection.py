"""Selection of settings: places along a path, queries to choose on, queries to report on, and the best setting."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.ground_truth import Unit
from mfvpr.datasets.positives import Positives, stack_positives


class Half(NamedTuple):
    """Two disjoint parts of a path: settings are chosen or learned on one, and reported on the other.

    tune: query rows to choose on.
    report: query rows to report on.
    allowed: database rows that may be used while choosing.
    paths: number of queries to choose on of each path, if there are several paths one after the other.
    """

    tune: Int[np.ndarray, " tune"]
    report: Int[np.ndarray, " report"]
    allowed: Bool[np.ndarray, " database"]
    paths: tuple[int, ...] = ()


def halves(positives: Positives) -> tuple[Half, Half]:
    """Split the queries into two contiguous blocks; each block is reported on once.

    Choosing sees nothing of the reported places: database rows that show the place of a reported query are not allowed,
    and queries whose place such a row shows are left out (they are neighbors across the cut).

    Args:
        positives: database images of a query's place within the widest threshold, also images that are no positives
            (the query itself).
    """
    first, second = np.split(np.arange(len(positives)), [len(positives) // 2])
    return separate(positives, first, second), separate(positives, second, first)


def halves_of_map(parts: Sequence[Positives], unit: Unit) -> tuple[Half, Half]:
    """Split several sequences of one database, in any order of places, into two halves of the places.

    Queries without a place are split by their order in each sequence. The `parts` are as in `halves`.
    """
    together = stack_positives(parts)
    places = places_along_path(together, unit)
    there = places >= 0
    middle = np.median(places[there]) if there.any() else 0
    behind = places > middle
    if not behind.any():  # more than half of the queries show the last place
        behind = there & (places >= middle)
    for sequence in np.split(np.arange(len(together)), np.cumsum(list(map(len, parts)))[:-1]):
        nowhere = sequence[~there[sequence]]
        behind[nowhere[len(nowhere) // 2 :]] = True
    first, second = np.flatnonzero(~behind), np.flatnonzero(behind)
    return separate(together, first, second), separate(together, second, first)


def separate(positives: Positives, tune: Int[np.ndarray, " tune"], report: Int[np.ndarray, " report"]) -> Half:
    """Leave out query rows to choose on that share a place with a row to report on; see `halves`."""
    is_free = np.ones(positives.num_database, bool)
    is_free[positives.take(report).rows] = False
    is_apart = np.array([is_free[positives.of(query)].all() for query in tune], bool)
    return Half(tune[is_apart], report, is_free)


def neighboring_settings(axes: Mapping[str, Sequence[Any]], setting: int) -> list[int]:
    """Numbers of the settings of a grid that differ from a setting by one step along one axis."""
    shape = tuple(map(len, axes.values()))
    numbers = np.arange(math.prod(shape)).reshape(shape)
    place = np.unravel_index(setting, shape)
    around = []
    for axis, index in enumerate(place):
        line = numbers[(*place[:axis], slice(None), *place[axis + 1 :])]
        around += [*line[max(index - 1, 0) : index], *line[index + 1 : index + 2]]
    return list(map(int, around))


def best_setting(recall: Float[np.ndarray, " settings"], axes: Mapping[str, Sequence[Any]] | None = None) -> int:
    """The number of the setting with the highest recall.

    Among equal settings, the neighbors in the grid decide by their mean recall, which makes the choice depend less on
    luck. Then the first setting wins.
    """
    equal = np.flatnonzero(recall == recall.max())
    if axes is None:
        return int(equal[0])
    around = [np.mean(recall[neighboring_settings(axes, int(setting)) or [setting]]) for setting in equal]
    return int(equal[np.argmax(around)])


def places_along_path(shown: Positives, unit: Unit) -> Int[np.ndarray, " queries"]:
    """Places of the queries of one or several drives: whole numbers from 0 in the order of the map.

    Neighbors along a path fail together, which confidence intervals and tests must consider.

    Frames of the map are in the order of their rows. Images with positions may have any order: two images are neighbors
    if they show the place of the same query, and each connected part of the map is traversed from one of its ends. With
    the unit "exact", images are in the order of the first queries that they show.

    Args:
        shown: images of the map that show each query's place, within a tolerance or a radius.
        unit: of the tolerance or radius.

    Returns:
        -1 for a query whose place no image shows.
    """
    orders = {"m": _traversal_order, "exact": _query_order}
    order = orders[unit](shown) if unit in orders else np.arange(shown.num_database)
    sums = np.add.reduceat(np.append(order[shown.rows], 0), shown.offsets[:-1]) if len(shown) else np.zeros(0)
    middle = sums / np.maximum(shown.counts, 1)
    return np.where(shown.counts > 0, np.unique(middle, return_inverse=True)[1], -1)


def _traversal_order(shown: Positives) -> np.ndarray:
    """Position `[N]` of each image in a traversal of its connected part of the map from an end."""
    queries, size = len(shown), len(shown) + shown.num_database
    pairs = np.repeat(np.arange(queries), shown.counts), queries + shown.rows
    graph = scipy.sparse.coo_array(
        (np.ones(2 * len(pairs[0])), (np.append(*pairs), np.append(*pairs[::-1]))), shape=(size, size)
    )
    graph = graph.tocsr()
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    rank, visited = np.zeros(size, int), 0
    for start in np.unique(part[pairs[1]], return_index=True)[1]:
        end = scipy.sparse.csgraph.breadth_first_order(graph, pairs[1][start], return_predecessors=False)[-1]
        order = scipy.sparse.csgraph.breadth_first_order(graph, end, return_predecessors=False)
        rank[order] = np.arange(visited, visited + len(order))
        visited += len(order)
    return rank[queries:]


def _query_order(shown: Positives) -> np.ndarray:
    """The first query `[N]` whose place each image shows."""
    first = np.full(shown.num_database, len(shown))
    np.minimum.at(first, shown.rows, np.repeat(np.arange(len(shown)), shown.counts))
    return first
