"""Which queries decide and which are reported on, what counts as right, and how sure a recall is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments import truth
from experiments.settings import SettingsError
from mfvpr import sweeping
from mfvpr.data.datasets import Dataset
from mfvpr.data.ground_truth import Unit, threshold_words
from mfvpr.sweeping import Half
from mfvpr.types import Shortlist


@dataclass(frozen=True)
class Judge:
    """What rankings are judged by.

    Attributes:
        thresholds: what counts as right, frames or meters.
        unit: of the thresholds.
        positives: `[threshold][Q, N]` bool.
        places: `[Q, N]` bool, images of a query's place at the widest threshold, also those that are no answer.
        halves: where to choose and where to report; none = both on all queries.
        views: candidates `[Q, C]` bool that are ranked: all, and for each half those that choosing may see.
    """

    thresholds: Sequence[float]
    unit: Unit
    positives: Sequence[np.ndarray]
    places: np.ndarray
    halves: Sequence[Half]
    views: Sequence[np.ndarray]

    @property
    def main(self) -> int:
        """The threshold that decides: the middle one."""
        return len(self.thresholds) // 2

    def of(self, candidates: Shortlist) -> "Judge":
        """With the views of a shortlist."""
        allowed = [half.allowed[np.maximum(candidates.indices, 0)] for half in self.halves]
        return replace(self, views=[candidates.mask, *(candidates.mask & one for one in allowed)])

    def label(self, k: int, threshold: float) -> str:
        """R@K and what counts, for tables."""
        return f"R@{k}{threshold_words(self.unit, threshold)}"

    def recall(self, rows: np.ndarray, k: int = 1) -> np.ndarray:
        """`[S, thresholds]` recall at k of all queries, of rows `[S, Q, depth]`."""
        return np.stack([sweeping.hits(rows, right, k).mean(axis=-1) for right in self.positives], axis=-1)

    def tuning(self, rows: np.ndarray) -> np.ndarray:
        """`[halves, S, thresholds]` recall at 1 that choosing may see, of rows `[V, S, Q, depth]`."""
        if not self.halves:
            return self.recall(rows[0])[None]
        seen = [
            [sweeping.hits(rows[view][:, half.tune], right[half.tune]).mean(axis=-1) for right in self.positives]
            for view, half in enumerate(self.halves, start=1)
        ]
        return np.moveaxis(np.array(seen), 1, -1)

    def reported(self, rows: np.ndarray, chosen: Sequence[int]) -> np.ndarray:
        """`[thresholds, R]` hits of the queries that are reported on, each by the setting chosen without it."""
        if not self.halves:
            return np.stack([sweeping.hits(rows[0][chosen[0]], right) for right in self.positives])
        parts = [
            [sweeping.hits(rows[0][setting][half.report], right[half.report]) for right in self.positives]
            for setting, half in zip(chosen, self.halves, strict=True)
        ]
        return np.concatenate([np.array(part) for part in parts], axis=1)


def judge(settings: dict[str, Any], dataset: Dataset) -> Judge:
    """Before matching: what is wrong with the ground truth is told early."""
    if dataset.truth is None:
        raise SettingsError(
            "dataset.ground_truth=none: choosing settings needs a ground truth; set order, index, utm or label"
        )
    thresholds = truth.thresholds(settings, dataset.truth)
    positives = [dataset.truth.positives(threshold) for threshold in thresholds]
    places = dataset.truth.shows_place(thresholds[-1])
    both = dict(zip(("first_half", "second_half"), sweeping.halves(places), strict=True))
    split = settings["split"]
    halves = list(both.values()) if split == "both" else [both[split]] if split else []
    for half in halves:
        if not len(half.tune) or not positives[-1][half.tune].any():
            raise SettingsError(f"split={split}: no query of one half has a place far enough from the other half; "
                                "use more queries or smaller tolerances")  # fmt: skip
    return Judge(thresholds, dataset.truth.unit, positives, places, halves, [])
