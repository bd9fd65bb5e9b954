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
from mfvpr.datasets.ground_truth import Truth, middle, threshold_words
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.confidence import (
    CalibrationData,
    Confidence,
    PrecisionRecall,
    absent_rankings,
    calibration_data,
    precision_recall,
)
from mfvpr.evaluation.dataset_ranking import KS, RankedDataset, Reason, Recall
from mfvpr.evaluation.protocol import Half, halves, halves_of_map
from mfvpr.evaluation.rankings import RETRIEVAL, Ranked
from mfvpr.report.runs import file_names
from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError

NO_PLACE = "no place"  # the prediction for a query whose place the database does not seem to show


@dataclass(frozen=True)
class EvaluationReport:
    """Rankings of a data set by a system, and the criteria of their report; arrays are of Q queries.

    Attributes:
        ranked: rankings of all sequences.
        thresholds: distances within which a prediction is correct, sorted; empty = those that the programs have by
            default. There are none without ground truth.
        ks: depths of recall, sorted.
        confidences: by system, fitted on other images; None = with ground truth, each half of the path has the
            confidence that was fitted on the other half.
        least_confidence: below which the prediction is `NO_PLACE`; None = no prediction is refused.
        lacking: by sequence, why there is too little evidence for predictions of the system that decides, which are
            `NO_PLACE` as well, see `mfvpr.evaluation.evidence`; None = not tested.
    """

    ranked: RankedDataset
    thresholds: Sequence[float] = ()
    ks: Sequence[int] = KS
    confidences: Mapping[str, Confidence] | None = None
    least_confidence: float | None = None
    lacking: Sequence[Sequence[Reason | None]] | None = None

    def __post_init__(self) -> None:
        truth = self.sequences[0].truth
        thresholds = [] if truth is None else self.thresholds or truth.thresholds()
        object.__setattr__(self, "thresholds", sorted({*thresholds}))
        object.__setattr__(self, "ks", sorted({*self.ks}))

    @property
    def headline(self) -> str:
        """The final score that decides, in predictions.csv and in figures."""
        return self.ranked.system.headline

    @property
    def histogram(self) -> HistogramOfShifts | None:
        """The main scorer of the final score that decides, if it is a histogram of shifts."""
        system = self.ranked.system
        scorers = [system.scorers[name] for name in system.final_scores[self.headline].scorers]
        return scorers[0] if scorers and isinstance(scorers[0], HistogramOfShifts) else None

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
        truth = self.sequences[0].truth
        if truth is None or not self.thresholds:
            return [{"recall_at": {}}]
        name, rows = {"frames": "tolerance", "m": "radius"}.get(truth.unit), []
        for sequence, recall in self.parts(system):
            for threshold, values in zip(self.thresholds, recall, strict=True):
                row: dict[str, Any] = {"sequence": sequence} if len(self.sequences) > 1 else {}
                row |= {name: threshold} if name else {}
                recall_at = {str(k): round(float(value), 6) for k, value in zip(self.ks, values, strict=True)}
                rows.append(row | {"recall_at": recall_at})
        return rows

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
        known = {name: fitted for name, fitted in self.confidences.items() if name in self.ranked.systems}
        return {name: np.concatenate([fitted(*pair) for pair in self._pairs(name)]) for name, fitted in known.items()}

    @cached_property
    def absent_probabilities(self) -> dict[str, Float[np.ndarray, " queries"]]:
        """Confidence by system of the queries without the images of their place; nothing without ground truth."""
        if self.confidences is None or not self.thresholds:
            return {name: absent for name, (_, absent) in self._cross_fitted.items()}
        probabilities = {}
        for name in self.probabilities:
            pairs = zip(self._pairs(name), self._truths, strict=True)
            absent = (absent_rankings(*pair, truth, self.threshold) for pair, truth in pairs)
            probabilities[name] = np.concatenate([self.confidences[name](*pair) for pair in absent])
        return probabilities

    @cached_property
    def calibration(self) -> dict[str, CalibrationData]:
        """Data that the confidence of a system is fitted on, by system; nothing without ground truth."""
        calibration = {}
        for name in self.ranked.systems if self.thresholds else ():
            pairs = zip(self._pairs(name), self._truths, strict=True)
            parts = [calibration_data(*pair, truth, self.threshold) for pair, truth in pairs]
            calibration[name] = CalibrationData(*map(np.concatenate, zip(*parts, strict=True)))
        return calibration

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

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """Precision and recall by the score, and by the confidence where it is known; with ground truth."""
        has_positives = np.concatenate([part.counts > 0 for part in self.positives if part is not None])
        values = {"score": self.scores(system)}
        if system in self.probabilities:
            values["confidence"] = self.probabilities[system]
        return {by: precision_recall(each, self.hits(system), has_positives) for by, each in values.items()}

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
    return run / "sequences" / file_names(sequences)[sequences[place]] if len(sequences) > 1 else run


def recall_table(evaluation: EvaluationReport) -> Table:
    """R@first k at every threshold, and all ks at the middle one; a line for each system, and sequence."""
    thresholds, ks, truth = evaluation.thresholds, evaluation.ks, evaluation.sequences[0].truth
    if truth is None or not thresholds:
        raise InputError(f"{evaluation.ranked.dataset.name}: there is no ground truth, so no recall; see `predictions`")
    cells = [(place, 0) for place in range(len(thresholds))]
    cells += [(len(thresholds) // 2, depth) for depth in range(1, len(ks))]
    labels = [f"R@{ks[depth]}{threshold_words(truth.unit, thresholds[place])}" for place, depth in cells]
    several, lines = len(evaluation.sequences) > 1, []
    for system in evaluation.ranked.systems:
        for name, recall in evaluation.parts(system):
            names = [system, name] if several else [system]
            lines.append([*names, *(f"{100 * recall[cell]:.1f}" for cell in cells)])
    names = ["system", "sequence"] if several else ["system"]
    return Table([*names, *labels], lines, text_columns=len(names))
