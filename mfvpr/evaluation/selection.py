"""Selection of settings: queries to choose on, queries to report on, and the best setting."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.positives import Positives, stack_positives
from mfvpr.datasets.truth import Unit
from mfvpr.evaluation.paths import places_along_path


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
