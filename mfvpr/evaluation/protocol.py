"""The protocol of an evaluation: which queries choose settings, which are reported on, and what is correct."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Bool, Float, Int

from mfvpr.core.metrics import hits
from mfvpr.core.types import Shortlist
from mfvpr.datasets.ground_truth import Truth, Unit, threshold_words
from mfvpr.datasets.positives import Positives, stack_positives
from mfvpr.utils.errors import InputError

Split = Literal["first_half", "second_half", "both"]
_HALVES = ("first_half", "second_half")
Queries = Int[np.ndarray, " _"]  # numbers of queries
Rows = Int[np.ndarray, "views settings queries depth"]  # rankings of the database by settings, within views


class Half(NamedTuple):
    """Two disjoint parts of a path: settings are chosen or learned on one, and reported on the other."""

    tune: Queries  # to choose on
    report: Queries  # to report on
    allowed: Bool[np.ndarray, " database"]  # database rows that may be used while choosing
    paths: tuple[int, ...] = ()  # number of queries to choose on of each path, if there are several


def halves(positives: Positives) -> tuple[Half, Half]:
    """Split the queries into two contiguous blocks; each block is reported on once.

    `positives` are all database images of a query's place within the widest threshold, the query itself included.
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


def separate(positives: Positives, tune: Queries, report: Queries) -> Half:
    """A half, in which choosing sees nothing of the reported places.

    Database rows that show the place of a reported query are not allowed, and queries whose place such a row shows are
    left out (they are neighbors across the cut).
    """
    is_free = np.ones(positives.num_database, bool)
    is_free[positives.take(report).rows] = False
    is_apart = np.array([is_free[positives.of(query)].all() for query in tune], bool)
    return Half(tune[is_apart], report, is_free)


def neighboring_settings(axes: Mapping[str, Sequence[Any]], setting: int) -> list[int]:
    """Numbers of the settings of a grid that differ from a setting by one step along one axis."""
    shape = tuple(map(len, axes.values()))
    place = np.array(np.unravel_index(setting, shape))
    steps = [sign * step for step in np.eye(len(shape), dtype=int) for sign in (-1, 1)]
    around = [tuple(place + step) for step in steps if ((place + step >= 0) & (place + step < shape)).all()]
    return [int(np.ravel_multi_index(each, shape)) for each in around]


def best_setting(recall: Float[np.ndarray, " settings"], axes: Mapping[str, Sequence[Any]] | None = None) -> int:
    """The number of the setting with the highest recall; of equal ones, that with the best neighbors in the grid."""
    equal = np.flatnonzero(recall == recall.max())
    if axes is None:
        return int(equal[0])
    around = [np.mean(recall[neighboring_settings(axes, int(setting)) or [setting]]) for setting in equal]
    return int(equal[np.argmax(around)])


def places_along_path(shown: Positives, unit: Unit) -> Int[np.ndarray, " queries"]:
    """Places of queries, from the images that show them: whole numbers from 0 in the order of the map, -1 = none.

    Frames of the map are in the order of their rows. Images with positions may have any order: two images are neighbors
    if they show the place of the same query, and each connected part of the map is traversed from one of its ends. With
    the unit "exact", images are in the order of the first queries that they show.
    """
    order = _traversal_order(shown) if unit == "m" else np.arange(shown.num_database)
    if unit == "exact":  # the first query whose place each image shows
        order = np.full(shown.num_database, len(shown))
        np.minimum.at(order, shown.rows, np.repeat(np.arange(len(shown)), shown.counts))
    sums = np.add.reduceat(np.append(order[shown.rows], 0), shown.offsets[:-1]) if len(shown) else np.zeros(0)
    middle = sums / np.maximum(shown.counts, 1)
    return np.where(shown.counts > 0, np.unique(middle, return_inverse=True)[1], -1)


def _traversal_order(shown: Positives) -> np.ndarray:
    """Position `[N]` of each image in a traversal of its connected part of the map from an end."""
    queries, images = len(shown), len(shown) + shown.rows
    shape = queries, shown.num_database
    shows = scipy.sparse.csr_array((np.ones(len(images)), shown.rows, shown.offsets), shape=shape)
    graph = scipy.sparse.block_array([[None, shows], [shows.T, None]], format="csr")
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    rank, visited = np.zeros(sum(shape), int), 0
    for start in np.unique(part[images], return_index=True)[1]:
        end = scipy.sparse.csgraph.breadth_first_order(graph, images[start], return_predecessors=False)[-1]
        order = scipy.sparse.csgraph.breadth_first_order(graph, end, return_predecessors=False)
        rank[order] = np.arange(visited, visited + len(order))
        visited += len(order)
    return rank[queries:]


@dataclass(frozen=True)
class EvaluationProtocol:
    """Ground truth at several thresholds, and a split into queries to choose on and queries to report on."""

    thresholds: Sequence[float]  # largest distances of a correct prediction, frames or meters, ascending
    unit: Unit
    positives: Sequence[Positives]
    places: Positives  # images of a query's place at the widest threshold, also those that are no positives
    halves: Sequence[Half]  # where to choose and where to report; none = both on all queries
    views: Sequence[Bool[np.ndarray, "queries candidates"]] = ()  # candidates: all, and for each half what it may see
    split: Split | Literal["other sets"] | None = None  # "other sets": halves are data sets; None = no halves
    reported_sets: Mapping[str, int] = field(default_factory=dict)  # queries of each set, if there are several

    @property
    def main(self) -> int:
        """The threshold that decides: the middle one."""
        return len(self.thresholds) // 2

    @property
    def names(self) -> list[str]:
        """Names of the halves."""
        return list(_HALVES) if self.split == "both" else [self.split] if self.split else []

    def of(self, candidates: Shortlist) -> "EvaluationProtocol":
        """The protocol with the views of a shortlist."""
        allowed = [half.allowed[np.maximum(candidates.indices, 0)] for half in self.halves]
        return replace(self, views=[candidates.mask, *(candidates.mask & rows for rows in allowed)])

    def label(self, k: int, threshold: float) -> str:
        """R@K with its threshold, for tables."""
        return f"R@{k}{threshold_words(self.unit, threshold)}"

    def hits(self, rows: np.ndarray, queries: Queries, k: int = 1) -> Bool[np.ndarray, "tolerances *batch queries"]:
        """Whether the first k rows of rankings `[..., queries, depth]` have a positive, by threshold."""
        return np.stack([hits(rows, positives.take(queries), k) for positives in self.positives])

    def recall(self, rows: np.ndarray, k: int = 1) -> Float[np.ndarray, "settings tolerances"]:
        """Recall@k over all queries of rankings `[settings, queries, depth]`."""
        return self.hits(rows, np.arange(rows.shape[1]), k).mean(axis=-1).T

    def tuning(self, rows: Rows) -> Float[np.ndarray, "halves settings tolerances"]:
        """Recall@1 over the queries to choose on."""
        if not self.halves:
            return self.recall(rows[0])[None]
        views = zip(rows[1:], self.halves, strict=True)
        return np.stack([self.hits(view[:, half.tune], half.tune).mean(axis=-1).T for view, half in views])

    def reported_hits(self, rows: Rows, chosen: Sequence[int]) -> Bool[np.ndarray, "tolerances reported"]:
        """Hits of the queries to report on, each with the setting that was chosen without it."""
        if not self.halves:
            return self.hits(rows[0][chosen[0]], np.arange(rows.shape[2]))[:, self.order]
        parts = zip(chosen, self.halves, strict=True)
        return self.join_halves([self.hits(rows[0][setting][half.report], half.report) for setting, half in parts])

    def join_halves(self, parts: Sequence[Bool[np.ndarray, "tolerances _"]]) -> Bool[np.ndarray, "tolerances reported"]:
        """Join the hits of each half in the order of the path, which confidence intervals depend on."""
        place = np.argsort(self.order)[np.concatenate([half.report for half in self.halves])]
        return np.concatenate(parts, axis=1)[:, np.argsort(place)]

    @cached_property
    def order(self) -> Int[np.ndarray, " queries"]:
        """Queries in the order of their path, data set by data set."""
        if self.unit != "m":  # images with positions may have any order
            return np.arange(len(self.places))
        places = places_along_path(self.places, self.unit)
        sizes = [*self.reported_sets.values()]
        before = len(self.places) - sum(sizes)  # queries that are learned on
        part = np.repeat(np.arange(len(sizes) + 1), [before, *sizes])
        return np.lexsort((places, part))


def evaluation_protocol(truth: Truth, thresholds: Iterable[float], split: Split | None = None) -> EvaluationProtocol:
    """Prepare an `EvaluationProtocol` before anything is ranked, so that errors of the ground truth are raised early.

    The `split` is the half of the path to choose on, or both in turn; None = choose and report on all queries. Queries
    to choose on and to report on share no place within the widest threshold. An InputError without thresholds, or for a
    half without queries to choose on.
    """
    thresholds = sorted(set(thresholds))
    if not thresholds:
        raise InputError("thresholds: expected at least one, got none")
    if split not in (None, *_HALVES, "both"):
        raise InputError(f"split={split}: expected one of None, {', '.join(_HALVES)}, both")
    positives = [truth.positives(threshold) for threshold in thresholds]
    places = truth.shows_place(thresholds[-1])
    chosen = [half for name, half in zip(_HALVES, halves(places), strict=True) if split in (name, "both")]
    for half in chosen:
        if not len(positives[-1].take(half.tune).rows):
            reason = "no query of one half has a place far enough from the other half"
            raise InputError(f"split={split}: {reason}; use more queries, or smaller tolerances or radius")
    return EvaluationProtocol(thresholds, truth.unit, positives, places, chosen, split=split)
