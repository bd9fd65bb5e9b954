"""The protocol of an evaluation: which queries choose settings, which are reported on, and what is correct."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.metrics import hits
from mfvpr.core.types import Shortlist
from mfvpr.datasets.ground_truth import Truth, Unit, threshold_words
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.selection import Half, halves, places_along_path
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import content_hash

Split = Literal["first_half", "second_half", "both"]
_HALVES = ("first_half", "second_half")


@dataclass(frozen=True)
class EvaluationProtocol:
    """Ground truth at several thresholds, and a split into queries to choose on and queries to report on.

    Attributes:
        thresholds: largest distances of a correct prediction, frames or meters, ascending.
        places: images of a query's place at the widest threshold, also those that are no positives.
        halves: where to choose and where to report; none = both on all queries.
        views: candidates that are ranked: all, and for each half those that choosing may see.
        split: which half to choose on, or both in turn; "other sets" if the halves are complete data sets, see
            `mfvpr.tuning.learning.data_sets`; None = no halves.
        reported_sets: number of queries of each data set that is reported on, by name, if there are several sets.
    """

    thresholds: Sequence[float]
    unit: Unit
    positives: Sequence[Positives]
    places: Positives
    halves: Sequence[Half]
    views: Sequence[Bool[np.ndarray, "queries candidates"]] = ()
    split: Split | Literal["other sets"] | None = None
    reported_sets: Mapping[str, int] = field(default_factory=dict)

    @property
    def main(self) -> int:
        """The threshold that decides: the middle one."""
        return len(self.thresholds) // 2

    @property
    def names(self) -> list[str]:
        """Names of the halves."""
        return list(_HALVES) if self.split == "both" else [self.split] if self.split else []

    @property
    def fingerprint(self) -> str:
        """Hash of the positives at each threshold."""
        return content_hash([(positives.offsets, positives.rows) for positives in self.positives])

    def of(self, candidates: Shortlist) -> "EvaluationProtocol":
        """This protocol with the views of a shortlist."""
        allowed = [half.allowed[np.maximum(candidates.indices, 0)] for half in self.halves]
        return replace(self, views=[candidates.mask, *(candidates.mask & rows for rows in allowed)])

    def label(self, k: int, threshold: float) -> str:
        """R@K with its threshold, for tables."""
        return f"R@{k}{threshold_words(self.unit, threshold)}"

    def recall(
        self, rows: Int[np.ndarray, "settings queries depth"], k: int = 1
    ) -> Float[np.ndarray, "settings tolerances"]:
        """Recall@k over all queries."""
        return np.stack([hits(rows, positives, k).mean(axis=-1) for positives in self.positives], axis=-1)

    def tuning(
        self, rows: Int[np.ndarray, "views settings queries depth"]
    ) -> Float[np.ndarray, "halves settings tolerances"]:
        """Recall@1 over the queries to choose on."""
        if not self.halves:
            return self.recall(rows[0])[None]
        seen = [
            [hits(rows[view][:, half.tune], positives.take(half.tune)).mean(axis=-1) for positives in self.positives]
            for view, half in enumerate(self.halves, start=1)
        ]
        return np.moveaxis(np.array(seen), 1, -1)

    def reported_hits(
        self, rows: Int[np.ndarray, "views settings queries depth"], chosen: Sequence[int]
    ) -> Bool[np.ndarray, "tolerances reported"]:
        """Hits of the queries to report on, each with the setting that was chosen without it."""
        if not self.halves:
            return np.stack([hits(rows[0][chosen[0]], positives) for positives in self.positives])[:, self.order]
        parts = [
            [hits(rows[0][setting][half.report], positives.take(half.report)) for positives in self.positives]
            for setting, half in zip(chosen, self.halves, strict=True)
        ]
        return self.join_halves([np.array(part) for part in parts])

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

    Args:
        truth: of the queries, in the order of their path.
        thresholds: at least one, in any order. The middle one decides. Queries to choose on and queries to report on
            share no place within the widest one.
        split: the half of the path to choose on, or both in turn; None = choose and report on all queries.

    Raises:
        InputError: no threshold, or a half without queries to choose on.
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
