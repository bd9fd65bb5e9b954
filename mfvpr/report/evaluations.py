"""The report of an evaluation in memory: recall, confidences of the first predictions, and their tables."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.datasets import MEANS, QuerySequence
from mfvpr.datasets.ground_truth import Truth, Unit, middle, threshold_words
from mfvpr.datasets.positives import Positives, stack_positives
from mfvpr.evaluation import confidence
from mfvpr.evaluation.calibration import CalibrationData, absent_ranking, calibration_data
from mfvpr.evaluation.confidence import Confidence, PrecisionRecall
from mfvpr.evaluation.dataset_ranking import KS, RankedDataset, Reason
from mfvpr.evaluation.protocol import Half, halves, halves_of_map
from mfvpr.evaluation.rankings import Ranked
from mfvpr.report.runs import Table, file_names, table_of
from mfvpr.utils.errors import InputError

NO_PLACE = "no place"  # the prediction for a query whose place the database does not seem to show
_UNITS: Mapping[str, Unit] = {"tolerance": "frames", "radius": "m"}  # of a threshold, by its name in rows


@dataclass(frozen=True)
class EvaluationReport:
    """Rankings of a data set by a system, and the criteria of their report; arrays are of Q queries."""

    ranked: RankedDataset
    thresholds: Sequence[float] = ()  # of a correct prediction, sorted; empty = the default of the programs
    ks: Sequence[int] = KS  # depths of recall, sorted
    # By system, fitted on other images; None = with ground truth, each half of the path has a fit on the other half.
    confidences: Mapping[str, Confidence] | None = None
    least_confidence: float | None = None  # below which the prediction is `NO_PLACE`; None = none is refused
    # By sequence, why evidence is lacking for predictions of the system that decides, which are then `NO_PLACE`.
    lacking: Sequence[Sequence[Reason | None]] | None = None

    def __post_init__(self) -> None:
        thresholds = [] if self.truth is None else self.thresholds or self.truth.thresholds()
        object.__setattr__(self, "thresholds", sorted({*thresholds}))
        object.__setattr__(self, "ks", sorted({*self.ks}))

    @property
    def headline(self) -> str:
        """The final score that decides."""
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

    @property
    def truth(self) -> Truth | None:
        """Ground truth of the first sequence; the others have one of the same unit, if there is any."""
        return self.sequences[0].truth

    def rows(self) -> list[dict[str, Any]]:
        """Recall by K of every system, threshold and sequence; behind several sequences, of their means.

        "sequence" is there if there are several; "recall_at" is empty without ground truth.
        """
        truth, rows = self.truth, list[dict[str, Any]]()
        if truth is None:
            parts = [{"sequence": sequence.name} for sequence in self.sequences] if len(self.sequences) > 1 else [{}]
            systems = [{"system": name, "decides": name == self.headline} for name in self.ranked.systems]
            return [system | part | {"recall_at": {}} for system in systems for part in parts]
        for system, recall in self.ranked.recall(self.thresholds, self.ks).items():
            parts = dict(zip((sequence.name for sequence in self.sequences), recall.by_sequence, strict=True))
            if len(parts) > 1:
                parts |= zip(MEANS, (recall.mean, recall.pooled), strict=True)
            for sequence, by_threshold in parts.items():
                for threshold, values in zip(self.thresholds, by_threshold.tolist(), strict=True):
                    row: dict[str, Any] = {"system": system, "decides": system == self.headline}
                    row |= {"sequence": sequence} if len(parts) > 1 else {}
                    row |= {name: threshold for name, unit in _UNITS.items() if unit == truth.unit}
                    rows.append(row | {"recall_at": dict(zip(self.ks, values, strict=True))})
        return rows

    @cached_property
    def queries(self) -> list[tuple[QuerySequence, str]]:
        """Sequence and name of each of the Q queries, sequence by sequence."""
        return [(sequence, name) for sequence in self.sequences for name in sequence.images.names]

    @cached_property
    def parts(self) -> list[slice]:
        """The queries of each sequence."""
        ends = np.cumsum([len(sequence.images) for sequence in self.sequences]).tolist()
        return [slice(start, end) for start, end in itertools.pairwise([0, *ends])]

    @cached_property
    def rankings(self) -> dict[str, Ranked]:
        """Rankings of all queries, by system."""
        rankings = {}
        for name, parts in self.ranked.systems.items():
            rows, scores = [part.rows for part in parts], [part.scores for part in parts]
            rankings[name] = Ranked(np.concatenate(rows), np.concatenate(scores))
        return rankings

    @cached_property
    def positives(self) -> Positives | None:
        """Positives of all queries, within `threshold`; None without ground truth."""
        return stack_positives(self.ranked.positives(self.threshold)) if self.thresholds else None

    @cached_property
    def correct(self) -> dict[str, Bool[np.ndarray, "queries candidates"]]:
        """Whether candidates are correct, in the order of the ranking, by system; empty without ground truth."""
        known = self.positives
        return {} if known is None else {name: known.contains(each.rows) for name, each in self.rankings.items()}

    def hits(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the first prediction is correct, with ground truth."""
        return self.correct[system][:, 0]

    def folder(self, run: Path, place: int) -> Path:
        """The folder of the sequence at a place."""
        return sequence_folder(run, [sequence.name for sequence in self.sequences], place)

    @cached_property
    def probabilities(self) -> dict[str, Float[np.ndarray, "2 queries"]]:
        """Confidence by system, of the queries as they are, and without the images of their place.

        Without `confidences`, each half of the path has those of a fit on the other half, without places of both.
        NaN without a prediction, or without anything to fit on.
        """
        names = self.calibration if self.confidences is None else self.confidences
        both = {name: np.full((2, len(self.queries)), np.nan) for name in names if name in self.rankings}
        for name, (present, absent) in both.items():
            if self.confidences is not None:
                present[:] = self.confidences[name](self.rankings[name])
                parts = self.parts, self.ranked.systems[name], self._truths
                for part, ranked, truth in zip(*parts, strict=True) if self.thresholds else ():
                    absent[part] = self.confidences[name](absent_ranking(ranked, truth, self.threshold))
                continue
            for half in self.path_halves():
                tune, report = self.calibration[name].take(half.tune), self.calibration[name].take(half.report)
                if np.isfinite(tune.present).all(axis=1).any():
                    fitted = tune.fit()
                    present[half.report] = fitted.probability(report.present)
                    absent[half.report] = fitted.probability(report.absent)
        return both

    @cached_property
    def calibration(self) -> dict[str, CalibrationData]:
        """Data that the confidence of a system is fitted on, by system; nothing without ground truth."""
        calibration = {}
        for name, rankings in self.ranked.systems.items() if self.thresholds else ():
            pairs = zip(rankings, self._truths, strict=True)
            parts = [calibration_data(ranked, truth, self.threshold) for ranked, truth in pairs]
            calibration[name] = CalibrationData(*map(np.concatenate, zip(*parts, strict=True)))
        return calibration

    def reasons(self, system: str) -> Shaped[np.ndarray, " queries"]:
        """Why predictions are `NO_PLACE`, objects; None = they are not."""
        reasons = np.full(len(self.queries), None, object)
        if self.least_confidence is not None:
            reasons[~(self.probabilities[system][0] >= self.least_confidence)] = "low confidence"
        reasons[self.rankings[system].rows[:, 0] < 0] = "no candidates"
        if self.lacking is not None and system == self.headline:
            for query, reason in enumerate(itertools.chain(*self.lacking)):
                reasons[query] = reason or reasons[query]
        return reasons

    def refusals(self, system: str) -> Bool[np.ndarray, " queries"]:
        """Whether the threshold or the evidence refuses the prediction."""
        return np.array([self.least_confidence is not None and each is not None for each in self.reasons(system)])

    def curves(self, system: str) -> dict[str, PrecisionRecall]:
        """Precision and recall by the score, and by the confidence where it is known; with ground truth."""
        ranked = self.rankings[system]
        values = {"score": np.where(ranked.rows[:, 0] >= 0, ranked.scores[:, 0], np.nan)}
        if system in self.probabilities:
            values["confidence"] = self.probabilities[system][0]
        has_positives = None if self.positives is None else self.positives.counts > 0
        return {by: confidence.precision_recall(each, self.hits(system), has_positives) for by, each in values.items()}

    @property
    def _truths(self) -> list[Truth]:
        return [sequence.truth for sequence in self.sequences if sequence.truth is not None]

    def path_halves(self) -> tuple[Half, Half]:
        """Halves of the path; with several sequences, which may pass places in any order, halves of the database."""
        shown = [truth.shows_place(self.thresholds[-1]) for truth in self._truths]
        return halves(shown[0]) if len(shown) == 1 else halves_of_map(shown, self._truths[0].unit)


def sequence_folder(run: Path, sequences: Sequence[str], place: int) -> Path:
    """The folder of one sequence's files: the run's, or one below it if there are several sequences."""
    return run / "sequences" / file_names(sequences)[sequences[place]] if len(sequences) > 1 else run


def recall_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Recall in % from rows of `EvaluationReport.rows`, which may have a "data set", too; InputError without recalls.

    R@first k at every threshold, and all ks at the middle one; a line for each data set, system, and sequence.
    """
    names, groups = ("data set", "system", "sequence"), dict[tuple[str | None, ...], list[Mapping[str, Any]]]()
    for row in rows:
        if row["recall_at"]:
            groups.setdefault(tuple(row.get(name) for name in names), []).append(row)
    if not groups:
        raise InputError("table: there is no ground truth, so no recall; see `predictions`")
    lines = []
    for texts, group in groups.items():
        first, *deeper = group[0]["recall_at"]
        line = {name: text for name, text in zip(names, texts, strict=True) if text is not None}
        for row, k in [(row, first) for row in group] + [(group[len(group) // 2], k) for k in deeper]:
            words = [threshold_words(unit, row[name]) for name, unit in _UNITS.items() if name in row]
            line[f"R@{k}{''.join(words)}"] = f"{100 * row['recall_at'][k]:.1f}"
        lines.append(line)
    return table_of(lines, names)


def confidence_table(evaluation: EvaluationReport) -> Table:
    """Average precision, recall at 100 and 99 % precision, by score and by confidence; calibration; all in percent.

    "ECE with absent" counts each query once more without the images of its place, as the fits do. With
    `least_confidence`, counts of queries follow.
    """
    is_refusing, rows = evaluation.least_confidence is not None, []
    header = [f"{name} by {by}" for by in ("score", "confidence") for name in ("AP", "R@100P", "R@99P")]
    header += ["ECE", "by chance", "ECE with absent"]
    header += ["correct", "incorrect", "refused", "of these correct"] if is_refusing else []
    for name, (present, absent) in evaluation.probabilities.items():
        correct, fractions = evaluation.hits(name), list[float]()
        for curve in evaluation.curves(name).values():
            fractions += [curve.average_precision, curve.recall_at(1.0), curve.recall_at(0.99)]
        never = np.zeros(len(correct), bool)
        with_absent = confidence.reliability(np.append(present, absent), np.append(correct, never))
        fractions.append(confidence.reliability(present, correct).calibration_error)
        fractions += [confidence.chance_calibration_error(present), with_absent.calibration_error]
        known = 3 if np.isnan(present).all() else len(fractions)  # an unknown confidence has empty cells
        cells = [f"{100 * value:.1f}" for value in fractions[:known]] + [""] * (len(fractions) - known)
        if is_refusing:
            refused = evaluation.refusals(name)
            counts = (correct & ~refused, ~correct & ~refused, refused, refused & correct)
            cells += [str(int(selection.sum())) for selection in counts]
        rows.append([name, *cells])
    return Table(["system", *header], rows)
