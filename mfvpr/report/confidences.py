"""Confidence of first predictions: tables, files of predictions, calibration, figures."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mfvpr.evaluation.confidence import chance_calibration_error, reliability, write_confidences
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.report.evaluations import NO_PLACE, EvaluationReport
from mfvpr.report.plots import reliability_figure
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table, format_number, write_csv

SHARES = tuple(share / 20 for share in range(21))


def confidence_table(evaluation: EvaluationReport) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by confidence; calibration; counts of queries.

    All in percent but the counts, which need `least_confidence`. "ECE" is the expected calibration error of the queries
    as they are, "by chance" that of a perfectly calibrated confidence. "ECE with absent" counts each query once more
    without the images of its place, as the fits do.
    """
    header = [f"{name} by {by}" for by in ("score", "confidence") for name in ("AP", "R@100P", "R@99P")]
    header += ["ECE", "by chance", "ECE with absent"]
    rows = []
    for name, probabilities in evaluation.probabilities.items():
        fractions = []
        for curve in evaluation.curves(name).values():
            fractions += [curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99)]
        correct = evaluation.hits(name)
        fractions += [reliability(probabilities, correct).calibration_error, chance_calibration_error(probabilities)]
        both = np.concatenate([probabilities, evaluation.absent_probabilities[name]])
        fractions.append(reliability(both, np.append(correct, np.zeros(len(correct), bool))).calibration_error)
        known = 3 if np.isnan(probabilities).all() else len(fractions)  # an unknown confidence has empty cells
        cells = [f"{100 * value:.1f}" for value in fractions[:known]] + [""] * (len(fractions) - known)
        if evaluation.least_confidence is not None:
            refused = evaluation.refusals(name)
            counts = (correct & ~refused, ~correct & ~refused, refused, refused & correct)
            cells += [str(int(selection.sum())) for selection in counts]
        rows.append([name, *cells])
    if evaluation.least_confidence is not None:
        header += ["correct", "incorrect", "refused", "of these correct"]
    return Table(["system", *header], rows)


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
    shares = zip(SHARES, *recalls.values(), strict=True) if RETRIEVAL in evaluation.probabilities else ()
    lines = [[f"{share:.2f}", *(f"{100 * recall:.1f}" for recall in row)] for share, *row in shares]
    names = [name for name in evaluation.ranked.systems if name != RETRIEVAL]
    write_csv(folder / "rerank_share.csv", ["re-ranked", *names], lines)
    points = []
    for name in evaluation.ranked.systems:
        for by, curve in evaluation.curves(name).items():
            points += [[name, by, *map(format_number, point)] for point in zip(*curve, strict=True)]
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    usable = {
        name: data for name, data in evaluation.calibration.items() if np.isfinite(data.present).all(axis=1).any()
    }
    write_confidences(folder / "confidence.json", {name: data.fit() for name, data in usable.items()}, provenance)


def _write_top_predictions(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `top_predictions.csv` of every sequence.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE` for a
    `reason`; `refused` is then its name, and `outcome` is "refused". `absent_confidence` is the confidence of the query
    without the images of its place. `in_database` is 1 where the database shows the query's place; elsewhere `NO_PLACE`
    is correct.
    """
    header = ["query", "prediction", "refused", "score", "confidence", "absent_confidence", "correct", "outcome"]
    header += ["reason", "in_database"]
    name, database = evaluation.headline, evaluation.ranked.dataset.database.names
    absent = evaluation.absent_probabilities.get(name, np.full(evaluation.num_queries, np.nan))
    values = map(evaluation.by_sequence, (evaluation.reasons(name), evaluation.probabilities[name], absent))
    for place, (ranked, *parts) in enumerate(zip(evaluation.ranked.systems[name], *values, strict=True)):
        is_correct, positives = evaluation.is_correct(name, place), evaluation.positives[place]
        lines, names = [], evaluation.sequences[place].images.names
        for query, (image, reason, *both) in enumerate(zip(names, *parts, strict=True)):
            row = ranked.rows[query, 0]
            candidate = database[row] if row >= 0 else ""
            predictions = [NO_PLACE, candidate] if reason else [candidate, ""]
            numbers = [format_number(ranked.scores[query, 0])]
            numbers += ["" if np.isnan(p) else repr(float(p)) for p in both]  # rounding may move them to another bin
            correct = "" if is_correct is None else int(is_correct[query, 0])
            outcome = "refused" if reason else {"": "", 0: "incorrect", 1: "correct"}[correct]
            in_database = "" if positives is None else int(positives.counts[query] > 0)
            lines.append([image, *predictions, *numbers, correct, outcome, reason or "", in_database])
        write_csv(evaluation.folder(folder, place) / "top_predictions.csv", header, lines)


def confidence_figures(evaluation: EvaluationReport) -> list[Figure]:
    """Reliability of the confidences, with ground truth; other curves of confidences are on the page."""
    if not evaluation.thresholds or not evaluation.probabilities:
        return []
    probabilities = evaluation.probabilities.items()
    reliabilities = {name: reliability(values, evaluation.hits(name)) for name, values in probabilities}
    return [("reliability.png", partial(reliability_figure, reliabilities=reliabilities))]
