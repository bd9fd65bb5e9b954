"""Confidence of first predictions: tables, files of predictions, calibration, figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mfvpr.evaluation.calibration import Confidence, confidence_inputs, fit_confidence, write_confidences
from mfvpr.evaluation.evaluation import Reason
from mfvpr.evaluation.precision import PrecisionRecall, chance_calibration_error, precision_recall, reliability
from mfvpr.evaluation.selection import Half, halves, halves_of_map
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.plots import precision_recall_figure, reliability_figure, shares_figure
from mfvpr.report.rankings import NO_PLACE, format_number, write_csv
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table
from mfvpr.reranking.results import RETRIEVAL

_COUNTS = ("correct", "incorrect", "refused", "of these correct")
SHARES = tuple(share / 20 for share in range(21))


@dataclass(frozen=True)
class CalibratedPredictions:
    """An evaluation whose first predictions have a confidence; arrays are of the queries of all sequences.

    Attributes:
        evaluation: rankings of the systems, with ground truth or without.
        confidences: by system, fitted on other images; None = with ground truth, each half of the path has the
            confidence that was fitted on the other half.
        threshold: of the confidence, below which the prediction is `NO_PLACE`; None = no prediction is refused.
    """

    evaluation: EvaluationReport
    confidences: Mapping[str, Confidence] | None = None
    threshold: float | None = None

    @cached_property
    def probabilities(self) -> dict[str, Float[np.ndarray, " queries"]]:
        """Confidence by system, NaN without a prediction, or without anything to fit on."""
        systems = self.evaluation.ranked.systems
        if self.confidences is not None:
            return {name: confidence.probability(self._inputs(name, confidence))
                    for name, confidence in self.confidences.items() if name in systems}  # fmt: skip
        return {name: self._cross_fitted_probability(name) for name in systems} if self.evaluation.thresholds else {}

    @cached_property
    def fitted(self) -> dict[str, Confidence]:
        """Confidences by system for other images, fitted on all queries with ground truth; none without predictions."""
        systems = self.evaluation.ranked.systems if self.evaluation.thresholds else ()
        inputs = {name: self._inputs(name) for name in systems}
        return {name: fit_confidence(values, self.evaluation.hits(name)) for name, values in inputs.items()
                if np.isfinite(values).all(axis=1).any()}  # fmt: skip

    def scores(self, system: str) -> Float[np.ndarray, " queries"]:
        """Scores of the first predictions, NaN without one."""
        parts = self.evaluation.ranked.systems[system]
        return np.concatenate([np.where(ranked.rows[:, 0] >= 0, ranked.scores[:, 0], np.nan) for ranked in parts])

    @cached_property
    def has_positives(self) -> Bool[np.ndarray, " queries"]:
        """Whether the database shows the query's place, with ground truth."""
        return np.concatenate([part.counts > 0 for part in self.evaluation.positives if part is not None])

    def refusals(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the prediction is `NO_PLACE`."""
        if self.threshold is None:
            return np.zeros(len(self.scores(system)), bool)
        return ~(self.probabilities[system] >= self.threshold)

    @property
    def refused_of_headline(self) -> list[Bool[np.ndarray, " _"]]:
        """Refusals of each sequence, by the system that decides."""
        return self.evaluation.by_sequence(self.refusals(self.evaluation.headline))

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """Precision and recall by the score, and by the confidence where it is known."""
        by_kind = {"score": self.scores(system), "confidence": self.probabilities.get(system)}
        return {by: precision_recall(values, self.evaluation.hits(system), self.has_positives)
                for by, values in by_kind.items() if values is not None}  # fmt: skip

    def _inputs(self, system: str, like: Confidence | None = None) -> np.ndarray:
        options = {} if like is None else {"inputs": like.inputs, "apart": like.apart}
        pairs = zip(self.evaluation.ranked.systems[system], self.evaluation.ranked.systems[RETRIEVAL], strict=True)
        return np.concatenate([confidence_inputs(*pair, **options) for pair in pairs])

    def _cross_fitted_probability(self, system: str) -> np.ndarray:
        """Confidence on each half of the path by a fit on the other, without what shows places of both."""
        inputs, correct = self._inputs(system), self.evaluation.hits(system)
        probability = np.full(len(correct), np.nan)
        for half in self.path_halves():
            if np.isfinite(inputs[half.tune]).all(axis=1).any():
                confidence = fit_confidence(inputs[half.tune], correct[half.tune])
                probability[half.report] = confidence.probability(inputs[half.report])
        return probability

    def path_halves(self) -> tuple[Half, Half]:
        """Halves of the path; with several sequences, which may pass places in any order, halves of the database."""
        truths = [sequence.truth for sequence in self.evaluation.sequences if sequence.truth is not None]
        shown = [truth.shows_place(self.evaluation.thresholds[-1]) for truth in truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, truths[0].unit)


def confidence_table(calibrated: CalibratedPredictions) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by confidence; calibration; counts of queries.

    All in percent but the counts, which need a threshold. "by chance" is the expected calibration error of a perfectly
    calibrated confidence.
    """
    header = [f"{name} by {by}" for by in ("score", "confidence") for name in ("AP", "R@100P", "R@99P")]
    counts = () if calibrated.threshold is None else _COUNTS
    rows = [_confidence_row(calibrated, name) for name in calibrated.probabilities]
    return Table(["system", *header, "ECE", "by chance", *counts], rows)


def _confidence_row(calibrated: CalibratedPredictions, system: str) -> list[str]:
    percent = [value for curve in calibrated.curves(system).values()
               for value in (curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99))]  # fmt: skip
    probabilities, correct = calibrated.probabilities[system], calibrated.evaluation.hits(system)
    percent += [reliability(probabilities, correct).calibration_error, chance_calibration_error(probabilities)]
    known = 3 if np.isnan(probabilities).all() else len(percent)  # an unknown confidence has empty cells
    cells = [system, *(f"{100 * value:.1f}" if place < known else "" for place, value in enumerate(percent))]
    if calibrated.threshold is not None:
        refused = calibrated.refusals(system)
        counts = (correct & ~refused, ~correct & ~refused, refused, refused & correct)
        cells += [str(int(selection.sum())) for selection in counts]
    return cells


def share_table(calibrated: CalibratedPredictions) -> Table:
    """Recall at 1 of all queries, by the share of them that is re-ranked, see `recall_by_share`."""
    recalls = _recalls_by_share(calibrated)
    names = [name for name in calibrated.evaluation.ranked.systems if name != RETRIEVAL]
    rows = [[f"{share:.2f}", *(f"{100 * recall[place]:.1f}" for recall in recalls.values())]
            for place, share in enumerate(SHARES) if RETRIEVAL in calibrated.probabilities]  # fmt: skip
    return Table(["re-ranked", *names], rows, text_columns=0)


def _recalls_by_share(calibrated: CalibratedPredictions) -> dict[str, np.ndarray]:
    """`recall_by_share` of all systems but retrieval; none where the confidence of retrieval is not known."""
    systems = calibrated.evaluation.ranked.systems if RETRIEVAL in calibrated.probabilities else ()
    return {name: recall_by_share(calibrated, name) for name in systems if name != RETRIEVAL}


def recall_by_share(calibrated: CalibratedPredictions, system: str) -> Float[np.ndarray, " shares"]:
    """Recall at 1, by `SHARES`, of a system that re-ranks the queries with the lowest confidence of retrieval."""
    correct_by_retrieval, correct = calibrated.evaluation.hits(RETRIEVAL), calibrated.evaluation.hits(system)
    unsure = np.argsort(np.nan_to_num(calibrated.probabilities[RETRIEVAL], nan=-1.0), kind="stable")
    gains = np.concatenate([[0], np.cumsum(correct[unsure].astype(int) - correct_by_retrieval[unsure])])
    counts = np.round(np.array(SHARES) * len(correct)).astype(int)
    return (correct_by_retrieval.sum() + gains[counts]) / len(correct)


def write_confidence(folder: Path, calibrated: CalibratedPredictions, provenance: Mapping[str, Any]) -> None:
    """Write `top_predictions.csv` of every sequence; with ground truth, the tables, curves, and fits.

    `provenance` has JSON values that say how the confidences were fitted.
    """
    evaluation = calibrated.evaluation
    if evaluation.headline in calibrated.probabilities:
        _write_top_predictions(folder, calibrated)
    if not evaluation.thresholds:
        return
    for name, table in (("confidence", confidence_table(calibrated)), ("rerank_share", share_table(calibrated))):
        write_csv(folder / f"{name}.csv", table.header, table.rows)
    points = [[name, by, *map(format_number, point)] for name in evaluation.ranked.systems
              for by, curve in calibrated.curves(name).items() for point in zip(*curve, strict=True)]  # fmt: skip
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    write_confidences(folder / "confidence.json", calibrated.fitted, provenance)


def _write_top_predictions(folder: Path, calibrated: CalibratedPredictions) -> None:
    """Write `query,prediction,score,confidence,correct,reason,in_database`.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE`, so that
    calibration can be computed from the file. `reason` says why the prediction is `NO_PLACE`. `in_database` is 1 where
    the database shows the query's place; elsewhere `NO_PLACE` is correct. Without ground truth `correct` and
    `in_database` are empty.
    """
    evaluation, name = calibrated.evaluation, calibrated.evaluation.headline
    database = evaluation.ranked.dataset.database.names
    refused, probabilities = calibrated.refused_of_headline, evaluation.by_sequence(calibrated.probabilities[name])
    for place, ranked in enumerate(evaluation.ranked.systems[name]):
        is_correct, positives = evaluation.is_correct(name, place), evaluation.positives[place]
        lines = []
        for query, image in enumerate(evaluation.sequences[place].images.names):
            row, unsure = ranked.rows[query, 0], refused[place][query]
            reason: Reason | None = "no candidates" if row < 0 else "low confidence" if unsure else None
            values = (ranked.scores[query, 0], probabilities[place][query])
            numbers = ["" if np.isnan(value) else format_number(value) for value in values]
            correct = "" if is_correct is None else int(is_correct[query, 0])
            in_database = "" if positives is None else int(positives.counts[query] > 0)
            lines.append([image, NO_PLACE if reason else database[row], *numbers, correct, reason or "", in_database])
        header = ["query", "prediction", "score", "confidence", "correct", "reason", "in_database"]
        write_csv(evaluation.folder(folder, place) / "top_predictions.csv", header, lines)


def confidence_figures(calibrated: CalibratedPredictions) -> list[Figure]:
    """Precision against recall, reliability, and recall over the share that is re-ranked; with ground truth."""
    if not calibrated.evaluation.thresholds:
        return []
    curves = {name: calibrated.curves(name) for name in calibrated.evaluation.ranked.systems}
    figures: list[Figure] = [("precision_recall.png", partial(precision_recall_figure, curves=curves))]
    if calibrated.probabilities:
        reliabilities = {name: reliability(values, calibrated.evaluation.hits(name))
                         for name, values in calibrated.probabilities.items()}  # fmt: skip
        figures.append(("reliability.png", partial(reliability_figure, reliabilities=reliabilities)))
    if recalls := _recalls_by_share(calibrated):
        figures.append(("rerank_share.png", partial(shares_figure, shares=SHARES, recall=recalls)))
    return figures
