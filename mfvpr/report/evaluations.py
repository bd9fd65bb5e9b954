"""The report of an evaluation: recall, and confidences of the first predictions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mfvpr.datasets.datasets import MEANS, QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.datasets.truth import Unit, middle, threshold_words
from mfvpr.evaluation.calibration import fit_confidence
from mfvpr.evaluation.evaluation import KS, RankedDataset, Recall
from mfvpr.evaluation.metrics import PrecisionRecall, precision_recall
from mfvpr.evaluation.selection import Half, halves, halves_of_map
from mfvpr.report.runs import file_names
from mfvpr.report.tables import Table
from mfvpr.reranking.confidence import Confidence, confidence_inputs
from mfvpr.reranking.results import RETRIEVAL
from mfvpr.scoring.histogram import HistogramOfShifts
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
    """

    ranked: RankedDataset
    thresholds: Sequence[float]
    ks: Sequence[int]
    confidences: Mapping[str, Confidence] | None = None
    least_confidence: float | None = None

    @classmethod
    def of(
        cls, ranked: RankedDataset, thresholds: Sequence[float] | None = None, ks: Sequence[int] = KS, *,
        confidences: Mapping[str, Confidence] | None = None, least_confidence: float | None = None,
    ) -> "EvaluationReport":  # fmt: skip
        """The report with criteria in any order; without thresholds, those that the programs have by default."""
        truth = ranked.dataset.sequences[0].truth
        known = [] if truth is None else truth.thresholds() if thresholds is None else thresholds
        return cls(ranked, sorted({*known}), sorted({*ks}), confidences, least_confidence)

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
        systems = self.ranked.systems
        if self.confidences is not None:
            return {name: confidence.probability(self.confidence_inputs(name, confidence))
                    for name, confidence in self.confidences.items() if name in systems}  # fmt: skip
        return {name: self._cross_fitted_probability(name) for name in systems} if self.thresholds else {}

    def scores(self, system: str) -> Float[np.ndarray, " queries"]:
        """Scores of the first predictions, NaN without one."""
        parts = self.ranked.systems[system]
        return np.concatenate([np.where(ranked.rows[:, 0] >= 0, ranked.scores[:, 0], np.nan) for ranked in parts])

    def refusals(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the prediction is `NO_PLACE`."""
        if self.least_confidence is None:
            return np.zeros(self.num_queries, bool)
        return ~(self.probabilities[system] >= self.least_confidence)

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

    def confidence_inputs(self, system: str, like: Confidence | None = None) -> Float[np.ndarray, "queries inputs"]:
        """Inputs of the confidence of a system; those of a known confidence, or all."""
        options = {} if like is None else {"inputs": like.inputs, "apart": like.apart}
        pairs = zip(self.ranked.systems[system], self.ranked.systems[RETRIEVAL], strict=True)
        return np.concatenate([confidence_inputs(*pair, **options) for pair in pairs])

    def _cross_fitted_probability(self, system: str) -> np.ndarray:
        """Confidence on each half of the path by a fit on the other, without what shows places of both."""
        inputs, correct = self.confidence_inputs(system), self.hits(system)
        probability = np.full(len(correct), np.nan)
        for half in self.path_halves():
            if np.isfinite(inputs[half.tune]).all(axis=1).any():
                confidence = fit_confidence(inputs[half.tune], correct[half.tune])
                probability[half.report] = confidence.probability(inputs[half.report])
        return probability

    def path_halves(self) -> tuple[Half, Half]:
        """Halves of the path; with several sequences, which may pass places in any order, halves of the database."""
        truths = [sequence.truth for sequence in self.sequences if sequence.truth is not None]
        shown = [truth.shows_place(self.thresholds[-1]) for truth in truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, truths[0].unit)


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
