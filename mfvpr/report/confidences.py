"""Confidence of first predictions: tables, files of predictions, calibration, figures."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mfvpr.evaluation.confidence import write_confidences
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.evaluation.reliability import chance_calibration_error, reliability
from mfvpr.report.evaluation_files import NO_PLACE
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.plots import precision_recall_figure, reliability_figure, shares_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_number, write_csv

_COUNTS = ("correct", "incorrect", "refused", "of these correct")
TOP_PREDICTIONS = ("query", "prediction", "refused", "score", "confidence", "absent_confidence", "correct", "outcome",
                   "reason", "in_database")  # fmt: skip
SHARES = tuple(share / 20 for share in range(21))


def confidence_table(evaluation: EvaluationReport) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by confidence; calibration; counts of queries.

    All in percent but the counts, which need `least_confidence`. "ECE" is the expected calibration error of the queries
    as they are, "by chance" that of a perfectly calibrated confidence. "ECE with absent" counts each query once more
    without the images of its place, as the fits do.
    """
    header = [f"{name} by {by}" for by in ("score", "confidence") for name in ("AP", "R@100P", "R@99P")]
    counts = () if evaluation.least_confidence is None else _COUNTS
    rows = [_confidence_row(evaluation, name) for name in evaluation.probabilities]
    return Table(["system", *header, "ECE", "by chance", "ECE with absent", *counts], rows)


def _confidence_row(evaluation: EvaluationReport, system: str) -> list[str]:
    percent = [value for curve in evaluation.curves(system).values()
               for value in (curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99))]  # fmt: skip
    probabilities, correct = evaluation.probabilities[system], evaluation.hits(system)
    percent += [reliability(probabilities, correct).calibration_error, chance_calibration_error(probabilities)]
    both = np.concatenate([probabilities, evaluation.absent_probabilities[system]])
    percent.append(reliability(both, np.append(correct, np.zeros(len(correct), bool))).calibration_error)
    known = 3 if np.isnan(probabilities).all() else len(percent)  # an unknown confidence has empty cells
    cells = [system, *(f"{100 * value:.1f}" if place < known else "" for place, value in enumerate(percent))]
    if evaluation.least_confidence is not None:
        refused = evaluation.refusals(system)
        counts = (correct & ~refused, ~correct & ~refused, refused, refused & correct)
        cells += [str(int(selection.sum())) for selection in counts]
    return cells


def recalls_by_share(evaluation: EvaluationReport) -> dict[str, Float[np.ndarray, " shares"]]:
    """Recall at 1, by `SHARES`, of the systems that re-rank the queries with the lowest confidence of retrieval.

    It is empty where the confidence of retrieval is not known.
    """
    if RETRIEVAL not in evaluation.probabilities:
        return {}
    unsure = np.argsort(np.nan_to_num(evaluation.probabilities[RETRIEVAL], nan=-1.0), kind="stable")
    by_retrieval = evaluation.hits(RETRIEVAL)[unsure].astype(int)
    counts = np.round(np.array(SHARES) * len(unsure)).astype(int)
    recalls = {}
    for name in (name for name in evaluation.ranked.systems if name != RETRIEVAL):
        gains = np.concatenate([[0], np.cumsum(evaluation.hits(name)[unsure] - by_retrieval)])
        recalls[name] = (by_retrieval.sum() + gains[counts]) / len(unsure)
    return recalls


def write_confidence(folder: Path, evaluation: EvaluationReport, provenance: Mapping[str, Any]) -> None:
    """Write `top_predictions.csv` of every sequence; with ground truth, the tables, curves, and fits.

    `provenance` has JSON values that say how the confidences were fitted.
    """
    if evaluation.headline in evaluation.probabilities:
        _write_top_predictions(folder, evaluation)
    if not evaluation.thresholds:
        return
    table, recalls = confidence_table(evaluation), recalls_by_share(evaluation)
    write_csv(folder / "confidence.csv", table.header, table.rows)
    shares = [[f"{share:.2f}", *(f"{100 * recall[place]:.1f}" for recall in recalls.values())]
              for place, share in enumerate(SHARES) if RETRIEVAL in evaluation.probabilities]  # fmt: skip
    names = [name for name in evaluation.ranked.systems if name != RETRIEVAL]
    write_csv(folder / "rerank_share.csv", ["re-ranked", *names], shares)
    points = [[name, by, *map(format_number, point)] for name in evaluation.ranked.systems
              for by, curve in evaluation.curves(name).items() for point in zip(*curve, strict=True)]  # fmt: skip
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    fits = {name: data.fit() for name, data in evaluation.calibration.items()
            if np.isfinite(data.present).all(axis=1).any()}  # fmt: skip
    write_confidences(folder / "confidence.json", fits, provenance)


def _write_top_predictions(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `top_predictions.csv` of every sequence.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE` for a
    `reason`; `refused` is then its name, and `outcome` is "refused". `absent_confidence` is the confidence of the query
    without the images of its place. `in_database` is 1 where the database shows the query's place; elsewhere `NO_PLACE`
    is correct.
    """
    name, database = evaluation.headline, evaluation.ranked.dataset.database.names
    absent = evaluation.absent_probabilities.get(name, np.full(evaluation.num_queries, np.nan))
    values = map(evaluation.by_sequence, (evaluation.reasons(name), evaluation.probabilities[name], absent))
    for place, (ranked, *parts) in enumerate(zip(evaluation.ranked.systems[name], *values, strict=True)):
        is_correct, positives = evaluation.is_correct(name, place), evaluation.positives[place]
        lines = []
        names = evaluation.sequences[place].images.names
        for query, (image, reason, *both) in enumerate(zip(names, *parts, strict=True)):
            row, score = ranked.rows[query, 0], ranked.scores[query, 0]
            candidate = database[row] if row >= 0 else ""
            predictions = [NO_PLACE, candidate] if reason else [candidate, ""]
            numbers = ["" if np.isnan(score) else format_number(score)]
            numbers += ["" if np.isnan(p) else repr(float(p)) for p in both]  # rounding may move them to another bin
            correct = "" if is_correct is None else int(is_correct[query, 0])
            outcome = "refused" if reason else {"": "", 0: "incorrect", 1: "correct"}[correct]
            in_database = "" if positives is None else int(positives.counts[query] > 0)
            lines.append([image, *predictions, *numbers, correct, outcome, reason or "", in_database])
        write_csv(evaluation.folder(folder, place) / "top_predictions.csv", TOP_PREDICTIONS, lines)


def confidence_figures(evaluation: EvaluationReport) -> list[Figure]:
    """Precision against recall, reliability, and recall over the share that is re-ranked; with ground truth."""
    if not evaluation.thresholds:
        return []
    curves = {name: evaluation.curves(name) for name in evaluation.ranked.systems}
    figures: list[Figure] = [("precision_recall.png", partial(precision_recall_figure, curves=curves))]
    if evaluation.probabilities:
        reliabilities = {name: reliability(values, evaluation.hits(name))
                         for name, values in evaluation.probabilities.items()}  # fmt: skip
        figures.append(("reliability.png", partial(reliability_figure, reliabilities=reliabilities)))
    if recalls := recalls_by_share(evaluation):
        figures.append(("rerank_share.png", partial(shares_figure, shares=SHARES, recall=recalls)))
    return figures
