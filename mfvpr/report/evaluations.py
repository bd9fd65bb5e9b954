"""The report of an evaluation: recall, and confidences of the first predictions."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.datasets import MEANS, QuerySequence
from mfvpr.datasets.ground_truth import Truth, Unit, middle, threshold_words
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.confidence import CalibrationData, Confidence, absent_rankings, calibration_data
from mfvpr.evaluation.dataset_ranking import KS, RankedDataset, Reason, Recall
from mfvpr.evaluation.rankings import RETRIEVAL, Ranked
from mfvpr.evaluation.reliability import PrecisionRecall, precision_recall
from mfvpr.evaluation.selection import Half, halves, halves_of_map
from mfvpr.report.runs import file_names
from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError

_THRESHOLD_NAMES: dict[Unit, str] = {"frames": "tolerance", "m": "radius"}  # in results
_SEQUENCES = "sequences"  # the folder of a run in which each of several sequences has its own


@dataclass(frozen=True)
class EvaluationReport:
    """Rankings of a data set by a system, and the criteria of their report; arrays are of Q queries.

    Attributes:
        ranked: rankings of all sequences.
        thresholds: distances within which a prediction is correct, ascending; none without ground truth.
        ks: depths of recall.
        confidences: by system, fitted on other images; None = with ground truth, each half of the path has the
            confidence that was fitted on the other half.
        least_confidence: below which the prediction is `NO_PLACE`; None = no prediction is refused.
        lacking: by sequence, why there is too little evidence for predictions of the system that decides, which are
            `NO_PLACE` as well, see `mfvpr.evaluation.evidence`; None = not tested.
    """

    ranked: RankedDataset
    thresholds: Sequence[float]
    ks: Sequence[int]
    confidences: Mapping[str, Confidence] | None = None
    least_confidence: float | None = None
    lacking: Sequence[Sequence[Reason | None]] | None = None

    @classmethod
    def of(
        cls, ranked: RankedDataset, thresholds: Sequence[float] | None = None, ks: Sequence[int] = KS, *,
        confidences: Mapping[str, Confidence] | None = None, least_confidence: float | None = None,
        lacking: Sequence[Sequence[Reason | None]] | None = None,
    ) -> "EvaluationReport":  # fmt: skip
        """The report with criteria in any order; without thresholds, those that the programs have by default."""
        truth = ranked.dataset.sequences[0].truth
        known = [] if truth is None else truth.thresholds() if thresholds is None else thresholds
        return cls(ranked, sorted({*known}), sorted({*ks}), confidences, least_confidence, lacking)

    @property
    def headline(self) -> str:
        """The final score that decides, in predictions.csv and in figures."""
        return self.ranked.system.headline

    @property
    def histogram(self) -> HistogramOfShifts | None:
        """The main scorer of the final score that decides, if it is a histogram of shifts."""
        system = self.ranked.system
        scorers = system.final_scores[self.headline].scorers
        main = system.scorers[scorers[0]] if scorers else None
        return main if isinstance(main, HistogramOfShifts) else None

    @property
    def threshold(self) -> float:
        """The middle threshold, which decides in predictions, failures and figures."""
        return middle(self.thresholds)

    @property
    def sequences(self) -> Sequence[QuerySequence]:
        """The data set's query sequences."""
        return self.ranked.dataset.sequences

    @cached_property
    def recall(self) -> dict[str, Recall]:
        """Recall by system."""
        return self.ranked.recall(self.thresholds, self.ks)

    def parts(self, system: str) -> Iterator[tuple[str, Float[np.ndarray, "tolerances ks"]]]:
        """(sequence, recall), and behind several sequences their means."""
        recall = self.recall[system]
        yield from zip((sequence.name for sequence in self.sequences), recall.by_sequence, strict=True)
        if len(self.sequences) > 1:
            yield from zip(MEANS, (recall.mean, recall.pooled), strict=True)

    def rows(self, system: str) -> list[dict[str, Any]]:
        """Threshold and recall by K; for several sequences, of each sequence and their means."""
        truth, several = self.sequences[0].truth, len(self.sequences) > 1
        name = _THRESHOLD_NAMES.get(truth.unit) if truth else None
        return [
            ({"sequence": sequence} if several else {})
            | ({name: threshold} if name else {})
            | {"recall_at": {str(k): round(float(value), 6) for k, value in zip(self.ks, values, strict=True)}}
            for sequence, recall in (self.parts(system) if self.thresholds else ())
            for threshold, values in zip(self.thresholds, recall, strict=True)
        ] or [{"recall_at": {}}]

    @cached_property
    def positives(self) -> Sequence[Positives | None]:
        """Positives of each sequence, within `threshold`."""
        return self.ranked.positives(self.threshold) if self.thresholds else [None] * len(self.sequences)

    def is_correct(self, system: str, place: int) -> Bool[np.ndarray, "queries candidates"] | None:
        """Whether candidates are correct, in the order of a system's ranking of the sequence at a place."""
        positives = self.positives[place]
        return None if positives is None else positives.contains(self.ranked.systems[system][place].rows)

    def hits(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the first prediction is correct, for the queries of all sequences, with ground truth."""
        places = range(len(self.sequences))
        return np.concatenate([np.asarray(self.is_correct(system, place), bool)[:, 0] for place in places])

    @property
    def num_queries(self) -> int:
        """Number of queries of all sequences."""
        return sum(len(sequence.images) for sequence in self.sequences)

    def by_sequence(self, values: Shaped[np.ndarray, " _"]) -> list[Shaped[np.ndarray, " _"]]:
        """Split values of the queries of all sequences into those of each sequence."""
        return np.split(values, np.cumsum([len(sequence.images) for sequence in self.sequences])[:-1])

    def folder(self, run: Path, place: int) -> Path:
        """The folder of the sequence at a place."""
        return sequence_folder(run, [sequence.name for sequence in self.sequences], place)

    @cached_property
    def probabilities(self) -> dict[str, Float[np.ndarray, " queries"]]:
        """Confidence by system, NaN without a prediction, or without anything to fit on."""
        if self.confidences is None:
            return {name: present for name, (present, _) in self._cross_fitted.items()}
        return {name: np.concatenate([self.confidences[name](*pair) for pair in self._pairs(name)])
                for name in self.confidences if name in self.ranked.systems}  # fmt: skip

    @cached_property
    def absent_probabilities(self) -> dict[str, Float[np.ndarray, " queries"]]:
        """Confidence by system of the queries without the images of their place; nothing without ground truth."""
        if self.confidences is None or not self.thresholds:
            return {name: absent for name, (_, absent) in self._cross_fitted.items()}
        return {name: np.concatenate([self.confidences[name](*absent_rankings(*pair, truth, self.threshold))
                                      for pair, truth in zip(self._pairs(name), self._truths, strict=True)])
                for name in self.probabilities}  # fmt: skip

    @cached_property
    def calibration(self) -> dict[str, CalibrationData]:
        """Data that the confidence of a system is fitted on, by system; nothing without ground truth."""
        parts = {name: [calibration_data(*pair, truth, self.threshold)
                        for pair, truth in zip(self._pairs(name), self._truths, strict=True)]
                 for name in self.ranked.systems if self.thresholds}  # fmt: skip
        return {name: CalibrationData(*map(np.concatenate, zip(*each, strict=True))) for name, each in parts.items()}

    def scores(self, system: str) -> Float[np.ndarray, " queries"]:
        """Scores of the first predictions, NaN without one."""
        parts = self.ranked.systems[system]
        return np.concatenate([np.where(ranked.rows[:, 0] >= 0, ranked.scores[:, 0], np.nan) for ranked in parts])

    def reasons(self, system: str) -> Shaped[np.ndarray, " queries"]:
        """Why predictions are `NO_PLACE`, objects; None = they are not."""
        reasons = np.full(self.num_queries, None, object)
        if self.least_confidence is not None:
            reasons[~(self.probabilities[system] >= self.least_confidence)] = "low confidence"
        reasons[np.concatenate([ranked.rows[:, 0] < 0 for ranked in self.ranked.systems[system]])] = "no candidates"
        if self.lacking is not None and system == self.headline:
            lacking = np.array([*itertools.chain(*self.lacking)], object)
            reasons = np.where(lacking == None, reasons, lacking)  # noqa: E711
        return reasons

    def refusals(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the threshold or the evidence refuses the prediction."""
        if self.least_confidence is None:
            return np.zeros(self.num_queries, bool)
        return np.array([reason is not None for reason in self.reasons(system)])

    @cached_property
    def refused(self) -> list[Bool[np.ndarray, " _"]]:
        """Refusals of each sequence, by the system that decides."""
        return self.by_sequence(self.refusals(self.headline))

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """Precision and recall by the score, and by the confidence where it is known; with ground truth."""
        has_positives = np.concatenate([part.counts > 0 for part in self.positives if part is not None])
        by_kind = {"score": self.scores(system), "confidence": self.probabilities.get(system)}
        return {by: precision_recall(values, self.hits(system), has_positives)
                for by, values in by_kind.items() if values is not None}  # fmt: skip

    @cached_property
    def _cross_fitted(self) -> dict[str, Float[np.ndarray, "2 queries"]]:
        """Confidence on each half of the path by a fit on the other, without what shows places of both.

        Of the queries as they are, and without the images of their place.
        """
        probabilities = {name: np.full((2, self.num_queries), np.nan) for name in self.calibration}
        for name, data in self.calibration.items():
            for half in self.path_halves():
                tune, report = data.take(half.tune), data.take(half.report)
                if np.isfinite(tune.present).all(axis=1).any():
                    fitted = map(tune.fit().probability, (report.present, report.absent))
                    probabilities[name][:, half.report] = [*fitted]
        return probabilities

    def _pairs(self, system: str) -> Iterator[tuple[Ranked, Ranked]]:
        """Rankings of each sequence by a system, and by retrieval."""
        return zip(self.ranked.systems[system], self.ranked.systems[RETRIEVAL], strict=True)

    @property
    def _truths(self) -> list[Truth]:
        """Ground truth of each sequence, if there is any."""
        return [sequence.truth for sequence in self.sequences if sequence.truth is not None]

    def path_halves(self) -> tuple[Half, Half]:
        """Halves of the path; with several sequences, which may pass places in any order, halves of the database."""
        shown = [truth.shows_place(self.thresholds[-1]) for truth in self._truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, self._truths[0].unit)


def sequence_folder(run: Path, sequences: Sequence[str], place: int) -> Path:
    """The folder of one sequence's files: the run's, or one below it if there are several sequences."""
    return run / _SEQUENCES / file_names(sequences)[sequences[place]] if len(sequences) > 1 else run


def recall_table(evaluation: EvaluationReport) -> Table:
    """R@first k at every threshold, and all ks at the middle one; a line for each system, and sequence."""
    truth, ks, main = evaluation.sequences[0].truth, evaluation.ks, len(evaluation.thresholds) // 2
    if not evaluation.thresholds:
        raise InputError(f"{evaluation.ranked.dataset.name}: there is no ground truth, so no recall; see `predictions`")
    cells = [(place, 0) for place in range(len(evaluation.thresholds))] + [(main, depth) for depth in range(1, len(ks))]
    unit = "exact" if truth is None else truth.unit
    labels = [f"R@{ks[depth]}{threshold_words(unit, evaluation.thresholds[place])}" for place, depth in cells]
    several = len(evaluation.sequences) > 1
    lines = [
        [system, *([name] if several else []), *(f"{100 * recall[cell]:.1f}" for cell in cells)]
        for system in evaluation.ranked.systems
        for name, recall in evaluation.parts(system)
    ]
    return Table(["system", *(["sequence"] if several else []), *labels], lines, text_columns=1 + several)
