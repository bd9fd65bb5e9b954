"""Confidence of first predictions: tables, files of predictions, calibration, figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mfvpr.evaluation.calibration import Confidence, confidence_inputs, fit_confidence, write_confidences
from mfvpr.evaluation.precision import (
    PrecisionRecall,
    Reliability,
    chance_calibration_error,
    precision_recall,
    reliability,
)
from mfvpr.evaluation.results import Reason
from mfvpr.evaluation.selection import Half, halves, halves_of_map
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.plots import precision_recall_figure, reliability_figure, shares_figure
from mfvpr.report.rankings import NO_PLACE, number, write_csv
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table
from mfvpr.reranking.results import FILTER

_COUNTS = ("right", "wrong", "refused", "of these right")
SHARES = tuple(share / 20 for share in range(21))


@dataclass(frozen=True)
class CalibratedPredictions:
    """An evaluation whose first predictions have a confidence; arrays are of the queries of all sequences.

    Attributes:
        judged: the evaluation.
        confidences: by system, fitted on other images; None = with ground truth, each half of the path has the
            confidence that was fitted on the other half.
        threshold: of p, below which the prediction is `NO_PLACE`; None = no prediction is refused.
    """

    judged: EvaluationReport
    confidences: Mapping[str, Confidence] | None = None
    threshold: float | None = None

    @cached_property
    def probabilities(self) -> dict[str, Float[np.ndarray, " queries"]]:
        """p(right) by system, NaN without a prediction, or without anything to fit on."""
        systems = self.judged.result.systems
        if self.confidences is not None:
            return {name: confidence.probability(self._inputs(name, confidence))
                    for name, confidence in self.confidences.items() if name in systems}  # fmt: skip
        return {name: self._cross_fitted_probability(name) for name in systems} if self.judged.thresholds else {}

    @cached_property
    def fitted(self) -> dict[str, Confidence]:
        """Confidences by system for other images, fitted on all queries with ground truth; none without predictions."""
        inputs = {name: self._inputs(name) for name in (self.judged.result.systems if self.judged.thresholds else ())}
        return {name: fit_confidence(values, self.right(name)) for name, values in inputs.items()
                if np.isfinite(values).all(axis=1).any()}  # fmt: skip

    def right(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the first prediction is correct, with ground truth."""
        return self.judged.hits(system)

    def scores(self, system: str) -> Float[np.ndarray, " queries"]:
        """Scores of the first predictions, NaN without one."""
        parts = self.judged.result.systems[system]
        return np.concatenate([np.where(ranked.rows[:, 0] >= 0, ranked.scores[:, 0], np.nan) for ranked in parts])

    @cached_property
    def has_answer(self) -> Bool[np.ndarray, " queries"]:
        """Whether the database shows the query's place, with ground truth."""
        return np.concatenate([positives.counts > 0 for positives in self.judged.positives if positives is not None])

    def refusals(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the prediction is `NO_PLACE`."""
        if self.threshold is None:
            return np.zeros(len(self.scores(system)), bool)
        return ~(self.probabilities[system] >= self.threshold)

    @property
    def refused_of_headline(self) -> list[Bool[np.ndarray, " _"]]:
        """Refusals of each sequence, by the system that decides."""
        return self.judged.by_sequence(self.refusals(self.judged.headline))

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """Precision and recall by the score, and by p where it is known."""
        confidences = {"score": self.scores(system)}
        if system in self.probabilities:
            confidences["p"] = self.probabilities[system]
        return {by: precision_recall(values, self.right(system), self.has_answer) for by, values in confidences.items()}

    def reliability(self, system: str) -> Reliability:
        """Reliability of p."""
        return reliability(self.probabilities[system], self.right(system))

    def _inputs(self, system: str, like: Confidence | None = None) -> np.ndarray:
        options = {} if like is None else {"inputs": like.inputs, "apart": like.apart}
        pairs = zip(self.judged.result.systems[system], self.judged.result.systems[FILTER], strict=True)
        return np.concatenate([confidence_inputs(*pair, **options) for pair in pairs])

    def _cross_fitted_probability(self, system: str) -> np.ndarray:
        """p of each half of the path by the other, without what shows places of both."""
        inputs, right = self._inputs(system), self.right(system)
        probability = np.full(len(right), np.nan)
        for half in self.path_halves():
            if np.isfinite(inputs[half.tune]).all(axis=1).any():
                confidence = fit_confidence(inputs[half.tune], right[half.tune])
                probability[half.report] = confidence.probability(inputs[half.report])
        return probability

    def path_halves(self) -> tuple[Half, Half]:
        """Halves of the path; with several sequences, which may pass places in any order, halves of the database."""
        truths = [sequence.truth for sequence in self.judged.sequences if sequence.truth is not None]
        shown = [truth.shows_place(self.judged.thresholds[-1]) for truth in truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, truths[0].unit)


def confidence_table(assured: CalibratedPredictions) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by p; calibration of p; counts of queries.

    All in percent but the counts, which need a threshold. "by chance" is the expected calibration error that p would
    have by chance if it were perfectly calibrated.
    """
    header = [f"{name} by {by}" for by in ("score", "p") for name in ("AP", "R@100P", "R@99P")]
    counts = () if assured.threshold is None else _COUNTS
    rows = [_confidence_row(assured, name) for name in assured.probabilities]
    return Table(["system", *header, "ECE of p", "by chance", *counts], rows)


def _confidence_row(assured: CalibratedPredictions, system: str) -> list[str]:
    percent = [
        value
        for curve in assured.curves(system).values()
        for value in (curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99))
    ]
    probabilities = assured.probabilities[system]
    percent += [assured.reliability(system).calibration_error, chance_calibration_error(probabilities)]
    known = 3 if np.isnan(probabilities).all() else len(percent)  # p that is unknown has empty cells
    cells = [system, *(f"{100 * value:.1f}" if place < known else "" for place, value in enumerate(percent))]
    if assured.threshold is not None:
        right, refused = assured.right(system), assured.refusals(system)
        counts = (right & ~refused, ~right & ~refused, refused, refused & right)
        cells += [str(int(selection.sum())) for selection in counts]
    return cells


def share_table(assured: CalibratedPredictions) -> Table:
    """Recall at 1 of all queries, by the share of them that is re-ranked, see `recall_by_share`."""
    recalls = _recalls_by_share(assured)
    names = [name for name in assured.judged.result.systems if name != FILTER]
    rows = [[f"{share:.2f}", *(f"{100 * recall[place]:.1f}" for recall in recalls.values())]
            for place, share in enumerate(SHARES) if FILTER in assured.probabilities]  # fmt: skip
    return Table(["re-ranked", *names], rows, text_columns=0)


def _recalls_by_share(assured: CalibratedPredictions) -> dict[str, np.ndarray]:
    """`recall_by_share` of all systems but the filter; none where p of the filter is not known."""
    systems = assured.judged.result.systems if FILTER in assured.probabilities else ()
    return {name: recall_by_share(assured, name) for name in systems if name != FILTER}


def recall_by_share(assured: CalibratedPredictions, system: str) -> Float[np.ndarray, " shares"]:
    """Recall at 1, by `SHARES`, of a system that re-ranks the queries with the lowest p of the filter."""
    filtered, right = assured.right(FILTER), assured.right(system)
    unsure = np.argsort(np.nan_to_num(assured.probabilities[FILTER], nan=-1.0), kind="stable")
    gains = np.concatenate([[0], np.cumsum(right[unsure].astype(int) - filtered[unsure])])
    counts = np.round(np.array(SHARES) * len(right)).astype(int)
    return (filtered.sum() + gains[counts]) / len(right)


def write_confidence(folder: Path, assured: CalibratedPredictions, provenance: Mapping[str, Any]) -> None:
    """Write `answers.csv` of every sequence where p is known; with ground truth, the tables, curves, and fits.

    `provenance` has JSON values that say how the confidences were fitted.
    """
    judged = assured.judged
    if judged.headline in assured.probabilities:
        _write_answers(folder, assured)
    if not judged.thresholds:
        return
    for name, table in (("confidence", confidence_table(assured)), ("rerank_share", share_table(assured))):
        write_csv(folder / f"{name}.csv", table.header, table.rows)
    points = [[name, by, *map(number, point)] for name in judged.result.systems
              for by, curve in assured.curves(name).items() for point in zip(*curve, strict=True)]  # fmt: skip
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    write_confidences(folder / "confidence.json", assured.fitted, provenance)


def _write_answers(folder: Path, assured: CalibratedPredictions) -> None:
    """Write `query,answer,score,p,right,reason,in_database`.

    `score`, `p` and `right` are of the first candidate, also where the answer is `NO_PLACE`, so that calibration can be
    computed from the file. `reason` says why the answer is `NO_PLACE`. `in_database` is 1 where the database shows the
    query's place; elsewhere `NO_PLACE` is correct. `right` and `in_database` are empty without ground truth.
    """
    judged, name = assured.judged, assured.judged.headline
    database = judged.result.dataset.database.names
    refused, probabilities = assured.refused_of_headline, judged.by_sequence(assured.probabilities[name])
    for place, ranked in enumerate(judged.result.systems[name]):
        is_right, positives = judged.is_right(name, place), judged.positives[place]
        lines = []
        for query, image in enumerate(judged.sequences[place].images.names):
            row, unsure = ranked.rows[query, 0], refused[place][query]
            reason: Reason | None = "no candidates" if row < 0 else "low confidence" if unsure else None
            values = (ranked.scores[query, 0], probabilities[place][query])
            numbers = ["" if np.isnan(value) else number(value) for value in values]
            right = "" if is_right is None else int(is_right[query, 0])
            in_database = "" if positives is None else int(positives.counts[query] > 0)
            lines.append([image, NO_PLACE if reason else database[row], *numbers, right, reason or "", in_database])
        header = ["query", "answer", "score", "p", "right", "reason", "in_database"]
        write_csv(judged.folder(folder, place) / "answers.csv", header, lines)


def confidence_figures(assured: CalibratedPredictions) -> list[Figure]:
    """Precision against recall, reliability, and recall over the share that is re-ranked; with ground truth."""
    if not assured.judged.thresholds:
        return []
    curves = {name: assured.curves(name) for name in assured.judged.result.systems}
    figures: list[Figure] = [("precision_recall.png", partial(precision_recall_figure, curves=curves))]
    if assured.probabilities:
        reliabilities = {name: assured.reliability(name) for name in assured.probabilities}
        figures.append(("reliability.png", partial(reliability_figure, reliabilities=reliabilities)))
    if FILTER in assured.probabilities:
        figures.append(("rerank_share.png", partial(shares_figure, shares=SHARES, recall=_recalls_by_share(assured))))
    return figures
