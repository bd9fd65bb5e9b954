"""Which setting is the best, on which queries that may be decided, and on which it may be reported."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mfvpr.datasets.positives import Positives, stacked
from mfvpr.datasets.truth import Unit
from mfvpr.evaluation.paths import places_along_path


class Half(NamedTuple):
    """A path cut in two: what is chosen or learned on one part, and reported on the other.

    tune: `[t]` query rows to choose on.  report: `[r]` query rows to report on.
    allowed: `[N]` bool, database rows that may be looked at while choosing.
    paths: how many of the queries to choose on each path has, one behind the other, where there are several.
    """

    tune: np.ndarray
    report: np.ndarray
    allowed: np.ndarray
    paths: tuple[int, ...] = ()


def halves(positives: Positives) -> tuple[Half, Half]:
    """The queries in two contiguous blocks, either of which is reported on once.

    While choosing, nothing of the reported places is seen: database rows that are right for a reported query are not
    allowed, and queries for which such a row is right are left out (they are neighbors across the cut).

    Args:
        positives: what shows a query's place within the widest threshold, also where that is no answer to it (an image
            that is the query itself).
    """
    first, second = np.split(np.arange(len(positives)), [len(positives) // 2])
    return separated(positives, first, second), separated(positives, second, first)


def halves_of_map(parts: Sequence[Positives], unit: Unit) -> tuple[Half, Half]:
    """The same for several sequences of one database, which pass its places in whatever order: halves of its places.

    Of the queries without a place, the first of each sequence are in the first half.

    Args:
        parts: of each sequence, as in `halves`.
        unit: of what shows a place.
    """
    together = stacked(parts)
    places = places_along_path(together, unit)
    there = places >= 0
    middle = np.median(places[there]) if there.any() else 0
    behind = places > middle
    if not behind.any():  # more than half of them wait at the end
        behind = there & (places >= middle)
    for own in np.split(np.arange(len(together)), np.cumsum(list(map(len, parts)))[:-1]):
        nowhere = own[~there[own]]
        behind[nowhere[len(nowhere) // 2 :]] = True
    first, second = np.flatnonzero(~behind), np.flatnonzero(behind)
    return separated(together, first, second), separated(together, second, first)


def separated(positives: Positives, tune: np.ndarray, report: np.ndarray) -> Half:
    """Query rows to choose on and to report on, without those that share a place; see `halves`."""
    reported = positives.take(report).union()
    return Half(tune[positives.take(tune).among(reported).counts == 0], report, ~reported)


def neighbors(axes: Mapping[str, Sequence[Any]], setting: int) -> list[int]:
    """Numbers of the settings of a grid that are one step along one axis away from a setting."""
    shape = tuple(map(len, axes.values()))
    place = np.array(np.unravel_index(setting, shape))
    found = []
    for axis, length in enumerate(shape):
        for step in (-1, 1):
            if 0 <= place[axis] + step < length:
                other = place.copy()
                other[axis] += step
                found.append(int(np.ravel_multi_index(tuple(other), shape)))
    return found


def best_setting(recall: np.ndarray, axes: Mapping[str, Sequence[Any]] | None = None) -> int:
    """The number of the setting with the highest `recall` `[S]`.

    Among equals, the one whose neighbors in the grid have the highest recall on average (it depends least on luck),
    and the first of those.
    """
    equal = np.flatnonzero(recall == recall.max())
    if axes is None:
        return int(equal[0])
    around = [np.mean(recall[neighbors(axes, int(setting))] if neighbors(axes, int(setting)) else recall[setting])
              for setting in equal]  # fmt: skip
    return int(equal[int(np.argmax(around))])
