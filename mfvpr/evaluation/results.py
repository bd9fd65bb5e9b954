"""Rankings of a data set: candidates, matches and rankings of every sequence, and their recall."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.recall import count_correct
from mfvpr.evaluation.system import System
from mfvpr.reranking.results import Matched, Ranked
from mfvpr.utils.errors import InputError

KS = (1, 5, 10)  # depths of recall, by default
Reason = Literal["no candidates", "too few features", "too few matches", "low confidence"]  # why there is no place


@dataclass(frozen=True, repr=False)
class Recall:
    """Recall of one system, from numbers of correct queries and of all queries."""

    correct: Int[np.ndarray, "sequences tolerances ks"]
    queries: Int[np.ndarray, " sequences"]

    def __repr__(self) -> str:
        return f"Recall({np.round(self.pooled, 3).tolist()} over all queries, by threshold and k)"

    @property
    def by_sequence(self) -> Float[np.ndarray, "sequences tolerances ks"]:
        """Recall of each sequence."""
        return self.correct / np.maximum(self.queries, 1)[:, None, None]

    @property
    def mean(self) -> Float[np.ndarray, "tolerances ks"]:
        """Plain mean over the sequences."""
        return self.by_sequence.mean(axis=0)

    @property
    def pooled(self) -> Float[np.ndarray, "tolerances ks"]:
        """Recall over all queries of all sequences."""
        return self.correct.sum(axis=0) / max(self.queries.sum(), 1)


@dataclass(frozen=True, repr=False)
class RankedDataset:
    """Rankings of one data set by one system.

    Attributes:
        matched: candidates and matches of each sequence.
        systems: rankings of each sequence, by name of the final score: retrieval alone, each scorer, combined scores.
        seconds: by stage.
    """

    dataset: Dataset
    system: System
    matched: Sequence[Matched]
    systems: Mapping[str, Sequence[Ranked]]
    seconds: Mapping[str, float]

    def __repr__(self) -> str:
        return f"RankedDataset({self.dataset!r} by {', '.join(self.systems)})"

    def positives(self, threshold: float) -> list[Positives]:
        """Positives at a threshold, by sequence; an InputError without a ground truth of all images."""
        if not threshold >= 0:
            raise InputError(f"threshold={threshold}: expected a number from 0")
        truths = [sequence.truth for sequence in self.dataset.sequences]
        if any(truth is None for truth in truths):
            raise InputError(f"{self.dataset.name}: there is no ground truth, so rankings only")
        positives = [truth.positives(threshold) for truth in truths if truth is not None]
        for sequence, truth in zip(self.dataset.sequences, positives, strict=True):
            expected, got = (len(sequence.images), len(self.dataset.database)), (len(truth), truth.num_database)
            if got != expected:
                raise InputError(f"{sequence.name}: expected a ground truth of {expected[0]} queries and {expected[1]} "
                                 f"database images, got one of {got[0]} and {got[1]}")  # fmt: skip
        return positives

    def recall(self, thresholds: Sequence[float], ks: Sequence[int] = KS) -> dict[str, Recall]:
        """Recall@K of every system; a query without positives counts as a failure.

        Args:
            thresholds: largest distances of a correct prediction, in the unit of the ground truth.
            ks: depths, from 1.

        Raises:
            InputError: as `positives`, or a depth below 1.
        """
        if min(ks, default=1) < 1:
            raise InputError(f"ks={[*ks]}: expected depths from 1")
        by_threshold = [self.positives(threshold) for threshold in thresholds]

        def count(rankings: Sequence[Ranked]) -> Recall:
            correct = [
                [count_correct(ranking.rows, positives[sequence], ks) for positives in by_threshold]
                for sequence, ranking in enumerate(rankings)
            ]
            return Recall(np.array(correct), np.array([len(ranking.rows) for ranking in rankings]))

        return {name: count(rankings) for name, rankings in self.systems.items()}
