"""What the first answers of an evaluation are worth with their confidence: tables, files of answers, figures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

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
from mfvpr.report.confidence_figures import precision_recall_figure, reliability_figure, shares_figure
from mfvpr.report.evaluations import Judged
from mfvpr.report.rankings import NO_PLACE, number, write_csv
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table
from mfvpr.reranking.results import FILTER

_COUNTS = ("right", "wrong", "refused", "of these right")
SHARES = tuple(share / 20 for share in range(21))


@dataclass(frozen=True)
class Assured:
    """An evaluation whose first answers have a confidence; arrays are of the queries of all sequences.

    Attributes:
        judged: the evaluation.
        given: what says p(right) of systems, by name, fitted on other images; None = with ground truth each half of
            the path is told by what was fitted on the other.
        threshold: of p, below which the answer is `NO_PLACE`; None = all are given.
    """

    judged: Judged
    given: Mapping[str, Confidence] | None = None
    threshold: float | None = None

    @cached_property
    def probabilities(self) -> dict[str, np.ndarray]:
        """p(right) `[Q]` by system, NaN where there is no answer, or nothing to fit on; none for others."""
        if self.given is not None:
            known = {name: one for name, one in self.given.items() if name in self.judged.result.systems}
            return {name: one.probability(self._inputs(name, one)) for name, one in known.items()}
        if not self.judged.thresholds:
            return {}
        return {name: self._crossed(name) for name in self.judged.result.systems}

    @cached_property
    def fitted(self) -> dict[str, Confidence]:
        """On all queries, by system: for other images. None without ground truth, or without any answer."""
        systems = self.judged.result.systems if self.judged.thresholds else ()
        inputs = {name: self._inputs(name) for name in systems}
        return {name: fit_confidence(values, self.right(name)) for name, values in inputs.items()
                if np.isfinite(values).all(axis=1).any()}  # fmt: skip

    def right(self, system: str) -> np.ndarray:
        """`[Q]` bool, whether the first answer is right, with ground truth."""
        return np.concatenate([
            np.asarray(self.judged.is_right(system, place), bool)[:, 0] for place in range(len(self.judged.sequences))
        ])  # fmt: skip

    def scores(self, system: str) -> np.ndarray:
        """`[Q]` of the first answers, NaN where there is none."""
        ranked = self.judged.result.systems[system]
        return np.concatenate([np.where(one.rows[:, 0] >= 0, one.scores[:, 0], np.nan) for one in ranked])

    @cached_property
    def has_answer(self) -> np.ndarray:
        """`[Q]` bool, whether the database shows the query's place, with ground truth."""
        return np.concatenate([right.counts > 0 for right in self.judged.right if right is not None])

    def refused(self, system: str) -> np.ndarray:
        """`[Q]` bool, answered `NO_PLACE`."""
        if self.threshold is None:
            return np.zeros(len(self.scores(system)), bool)
        return ~(self.probabilities[system] >= self.threshold)

    @property
    def refused_of_headline(self) -> list[np.ndarray]:
        """`[Q]` bool of each sequence, by the system that decides."""
        return self.by_sequence(self.refused(self.judged.headline))

    def by_sequence(self, values: np.ndarray) -> list[np.ndarray]:
        """Values of all queries, of each sequence."""
        return np.split(values, np.cumsum([len(sequence.images) for sequence in self.judged.sequences])[:-1])

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """By the score, and by p where it is known."""
        confidences = {"score": self.scores(system)}
        if system in self.probabilities:
            confidences["p"] = self.probabilities[system]
        return {by: precision_recall(one, self.right(system), self.has_answer) for by, one in confidences.items()}

    def reliability(self, system: str) -> Reliability:
        """Of p."""
        return reliability(self.probabilities[system], self.right(system))

    def _inputs(self, system: str, like: Confidence | None = None) -> np.ndarray:
        options = {} if like is None else {"inputs": like.inputs, "apart": like.apart}
        systems = self.judged.result.systems
        return np.concatenate([
            confidence_inputs(*pair, **options) for pair in zip(systems[system], systems[FILTER], strict=True)
        ])  # fmt: skip

    def _crossed(self, system: str) -> np.ndarray:
        """p of each half of the path by the other, without what shows places of both."""
        inputs, right = self._inputs(system), self.right(system)
        found = np.full(len(right), np.nan)
        for half in self.path_halves():
            if np.isfinite(inputs[half.tune]).all(axis=1).any():
                found[half.report] = fit_confidence(inputs[half.tune], right[half.tune]).probability(
                    inputs[half.report]
                )
        return found

    def path_halves(self) -> tuple[Half, Half]:
        """Of the path; of several sequences, which pass the same places in whatever order, of the database's."""
        truths = [sequence.truth for sequence in self.judged.sequences if sequence.truth is not None]
        shown = [truth.shows_place(self.judged.thresholds[-1]) for truth in truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, truths[0].unit)


def confidence_table(assured: Assured) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by p; the calibration of p; counts of queries.

    All in percent but the counts, which are there where a threshold is. Beside the expected calibration error stands
    the one that p would have by chance if it were perfectly calibrated.
    """
    header = [f"{name} by {by}" for by in ("score", "p") for name in ("AP", "R@100P", "R@99P")]
    counted = assured.threshold is not None
    header = ["system", *header, "ECE of p", "by chance", *(_COUNTS if counted else ())]
    return Table(header, [_line(assured, name, counted) for name in assured.probabilities])


def _line(assured: Assured, system: str, counted: bool) -> list[str]:
    percent = [
        value
        for curve in assured.curves(system).values()
        for value in (curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99))
    ]
    probabilities = assured.probabilities[system]
    percent += [assured.reliability(system).calibration_error, chance_calibration_error(probabilities)]
    known = 3 if np.isnan(probabilities).all() else len(percent)  # nothing is said of a p that there is not
    cells = [system, *(f"{100 * value:.1f}" if place < known else "" for place, value in enumerate(percent))]
    if counted:
        right, refused = assured.right(system), assured.refused(system)
        counts = (right & ~refused, ~right & ~refused, refused, refused & right)
        cells += [str(int(one.sum())) for one in counts]
    return cells


def share_table(assured: Assured) -> Table:
    """Recall at 1 of all queries where that share of them is re-ranked that the filter is the least sure of.

    Empty where p of the filter is not known.
    """
    known, judged = FILTER in assured.probabilities, assured.judged
    names = [name for name in judged.result.systems if name != FILTER]
    recall = [recall_by_share(assured, name) for name in names] if known else []
    rows = [[f"{share:.2f}", *(f"{100 * one[place]:.1f}" for one in recall)] for place, share in enumerate(SHARES)]
    return Table(["re-ranked", *names], rows if known else [], text_columns=0)


def recall_by_share(assured: Assured, system: str) -> np.ndarray:
    """`[SHARES]` recall at 1 of a system that re-ranks the queries the filter is the least sure of, with its p."""
    filtered, right = assured.right(FILTER), assured.right(system)
    unsure = np.argsort(np.nan_to_num(assured.probabilities[FILTER], nan=-1.0), kind="stable")
    gains = np.concatenate([[0], np.cumsum(right[unsure].astype(int) - filtered[unsure])])
    counts = np.round(np.array(SHARES) * len(right)).astype(int)
    return (filtered.sum() + gains[counts]) / len(right)


def write_confidence(folder: Path, assured: Assured, made: Mapping[str, Any]) -> None:
    """`answers.csv` of every sequence, where p is known; with ground truth the tables, curves, and what was fitted.

    Args:
        folder: of the run.
        assured: what is written.
        made: JSON values, how what is fitted here was made.
    """
    judged = assured.judged
    if judged.headline in assured.probabilities:
        _write_answers(folder, assured)
    if not judged.thresholds:
        return
    table, shares = confidence_table(assured), share_table(assured)
    write_csv(folder / "confidence.csv", table.header, table.rows)
    write_csv(folder / "rerank_share.csv", shares.header, shares.rows)
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], _points(assured))
    write_confidences(folder / "confidence.json", assured.fitted, made)


def _write_answers(folder: Path, assured: Assured) -> None:
    """`query,answer,score,p,right,reason,in_database`: score, p and `right` are of the first candidate, also where the
    answer is `NO_PLACE`, so that calibration can be computed from the file.

    `reason` says why the answer is `NO_PLACE`. `in_database` is 1 where the database shows the query's place: elsewhere
    `NO_PLACE` is correct. `right` and `in_database` are empty without ground truth.
    """
    judged, name = assured.judged, assured.judged.headline
    database = judged.result.dataset.database.names
    refused, probabilities = assured.refused_of_headline, assured.by_sequence(assured.probabilities[name])
    for place, ranked in enumerate(judged.result.systems[name]):
        is_right, truth = judged.is_right(name, place), judged.right[place]
        lines = []
        for query, image in enumerate(judged.sequences[place].images.names):
            row, unsure = ranked.rows[query, 0], refused[place][query]
            reason: Reason | None = "no candidates" if row < 0 else "low confidence" if unsure else None
            values = (ranked.scores[query, 0], probabilities[place][query])
            written = ["" if np.isnan(value) else number(value) for value in values]
            right = "" if is_right is None else int(is_right[query, 0])
            in_database = "" if truth is None else int(truth.counts[query] > 0)
            lines.append([image, NO_PLACE if reason else database[row], *written, right, reason or "", in_database])
        header = ["query", "answer", "score", "p", "right", "reason", "in_database"]
        write_csv(judged.folder(folder, place) / "answers.csv", header, lines)


def _points(assured: Assured) -> Iterator[Sequence[str]]:
    for name in assured.judged.result.systems:
        for by, curve in assured.curves(name).items():
            for point in zip(*curve, strict=True):
                yield [name, by, *map(number, point)]


def confidence_figures(assured: Assured) -> list[Figure]:
    """Precision against recall, reliability, and what re-ranking the unsure queries gives; with ground truth."""
    judged = assured.judged
    if not judged.thresholds:
        return []
    names = [*judged.result.systems]
    curves = {name: assured.curves(name) for name in names}
    figures: list[Figure] = [("precision_recall.png", partial(precision_recall_figure, curves=curves))]
    if assured.probabilities:
        reliable = {name: assured.reliability(name) for name in assured.probabilities}
        figures.append(("reliability.png", partial(reliability_figure, reliabilities=reliable)))
    if FILTER in assured.probabilities:
        recall = {name: recall_by_share(assured, name) for name in names if name != FILTER}
        figures.append(("rerank_share.png", partial(shares_figure, shares=SHARES, recall=recall)))
    return figures
