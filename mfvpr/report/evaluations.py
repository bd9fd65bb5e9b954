"""Reports of an evaluation: recall table, files of rankings, and figures of some queries."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Shaped

from mfvpr.datasets.datasets import MEANS, ImageFolder, QuerySequence
from mfvpr.datasets.images import resize
from mfvpr.datasets.positives import Positives
from mfvpr.datasets.truth import Unit, middle, threshold_words
from mfvpr.evaluation.evaluation import KS, RankedDataset, Recall
from mfvpr.evaluation.stages import explain
from mfvpr.report.file_names import file_names
from mfvpr.report.rankings import Rankings, write_failures, write_predictions
from mfvpr.report.runs import Figure
from mfvpr.report.tables import Table
from mfvpr.reranking.results import Matched, Ranked
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, printable, write_text

if TYPE_CHECKING:
    from mfvpr.report.figures import Candidate

ABOUT: tuple[str, ...] = ("system", "sequence", "outcome", "query", "prediction")  # keywords in the file of a figure
_THRESHOLD_NAMES: dict[Unit, str] = {"frames": "tolerance", "m": "radius"}  # in results
_NAME_LENGTH = 40  # characters in the title of a figure
_SEQUENCES = "sequences"  # the folder of a run in which each of several sequences has its own


@dataclass(frozen=True)
class EvaluationReport:
    """Rankings of a data set by a system, and the criteria of their report; arrays are of Q queries.

    Attributes:
        ranked: rankings of all sequences.
        thresholds: distances within which a prediction is correct, ascending; none without ground truth.
        ks: depths of recall.
    """

    ranked: RankedDataset
    thresholds: Sequence[float]
    ks: Sequence[int]

    @classmethod
    def of(
        cls, ranked: RankedDataset, thresholds: Sequence[float] | None = None, ks: Sequence[int] = KS
    ) -> "EvaluationReport":
        """The report with criteria in any order; without thresholds, those that the programs have by default."""
        truth = ranked.dataset.sequences[0].truth
        known = [] if truth is None else truth.thresholds() if thresholds is None else thresholds
        return cls(ranked, sorted({*known}), sorted({*ks}))

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


def write_rankings(
    folder: Path, evaluation: EvaluationReport, refused: Sequence[Bool[np.ndarray, " _"]] | None = None
) -> None:
    """Write `predictions/` and `failures/` of every system, those of the headline's into the folder itself.

    `refused` are queries of each sequence that the headline's predictions refuse; None = no query is refused.
    """
    database, files = evaluation.ranked.dataset.database.names, file_names([*evaluation.ranked.systems])
    for place, sequence in enumerate(evaluation.sequences):
        target = evaluation.folder(folder, place)
        for name, parts in evaluation.ranked.systems.items():
            ranked, correct = parts[place], evaluation.is_correct(name, place)
            rankings = Rankings(sequence.images.names, database, ranked.rows, ranked.scores, correct)
            write_predictions(target / "predictions" / f"{files[name]}.csv", rankings)
            write_failures(target / "failures" / f"{files[name]}.csv", rankings)
            if name == evaluation.headline:
                write_failures(target / "failures.csv", rankings)
                rankings = rankings if refused is None else replace(rankings, refused=refused[place])
                write_predictions(target / "predictions.csv", rankings)


def write_skipped(folder: Path, ranked: RankedDataset) -> None:
    """Write `skipped.csv` with images that could not be used and the reasons, if there are any."""
    names = ranked.dataset.database.names
    bad_rows = {bad for matched in ranked.matched for bad in matched.bad_database.items()}
    lines = sorted(("database", names[row], reason) for row, reason in bad_rows)
    lines += [("queries", matched.sequence.images.names[row], reason)
              for matched in ranked.matched for row, reason in matched.bad_queries.items()]  # fmt: skip
    if lines:
        write_text(folder / "skipped.csv", Table(["folder", "image", "reason"], lines).csv())


def query_figures(
    evaluation: EvaluationReport, shown: int | Sequence[int], refused: Sequence[Bool[np.ndarray, " _"]]
) -> list[Figure]:
    """The paper's figure for a few queries, correct and incorrect ones, spread over each sequence.

    `shown` is a number of queries, or their rows. `refused` are queries of each sequence whose confidence is below the
    threshold.
    """
    several, folders = len(evaluation.sequences) > 1, file_names([sequence.name for sequence in evaluation.sequences])
    figures: list[Figure] = []
    for place, sequence in enumerate(evaluation.sequences):
        drawings = SequenceFigures(evaluation, place, refused[place])
        folder = f"{folders[sequence.name]}/" if several else ""
        figures += [
            (f"{folder}{verdict}_{query:04d}.png", partial(drawings.draw, query=query, verdict=verdict))
            for query, verdict in drawings.verdicts(shown).items()
        ]
    return figures


@dataclass(frozen=True)
class SequenceFigures:
    """The figures of one sequence; arguments as of `query_figures`."""

    evaluation: EvaluationReport
    place: int
    refused: Bool[np.ndarray, " queries"]

    @property
    def _sequence(self) -> QuerySequence:
        return self.evaluation.sequences[self.place]

    @property
    def _matched(self) -> Matched:
        return self.evaluation.ranked.matched[self.place]

    @property
    def _ranked(self) -> Ranked:
        return self.evaluation.ranked.systems[self.evaluation.headline][self.place]

    @property
    def _database(self) -> ImageFolder:
        return self.evaluation.ranked.dataset.database

    def verdicts(self, selection: int | Sequence[int]) -> dict[int, str]:
        """Verdicts of queries that get a figure: the selected rows, or so many, half of them correct if known."""
        correct = self.evaluation.is_correct(self.evaluation.headline, self.place)
        has_prediction = self._ranked.rows[:, 0] >= 0
        words = ["best"] if correct is None else ["correct", "incorrect"]
        verdicts = np.full(len(has_prediction), "best") if correct is None else np.where(correct[:, 0], *words)
        if not isinstance(selection, int):
            return {query: str(verdicts[query]) for query in selection if has_prediction[query]}
        numbers = map(len, np.array_split(range(selection), len(words)))
        return {query: verdict for verdict, number in zip(words, numbers, strict=True)
                for query in _pick_evenly(np.flatnonzero(has_prediction & (verdicts == verdict)), number)}  # fmt: skip

    def title(self, query: int, verdict: str) -> str:
        """The score, whether the prediction is correct within the threshold, and both names."""
        truth = self._sequence.truth
        within = "" if truth is None else " at" + threshold_words(truth.unit, self.evaluation.threshold)
        names = f"{_short(self._sequence.images.names[query])} -> {_short(self._prediction(query))}"
        note = " (no place: confidence below the threshold)" if self.refused[query] else ""
        return f"{self.evaluation.headline}, {verdict}{within}: {names}{note}"

    def draw(self, path: Path, query: int, verdict: str) -> None:
        """Draw the prediction, and below an incorrect one a correct one."""
        from mfvpr.report.figures import histogram_figure, pixel_aspect_of  # here: matplotlib takes half a second

        candidates = [self._candidate(query, 0, verdict)]
        candidates += self.correct_candidates(query) if verdict == "incorrect" else []
        values = self.evaluation.headline, self._sequence.name, verdict, self._sequence.images.names[query]
        about = dict(zip(ABOUT, (*values, self._prediction(query)), strict=True))
        original = self._sequence.images.read(query)
        image = self._resize(original)
        aspect = pixel_aspect_of(original, image)
        histogram_figure(path, image, candidates, title=self.title(query, verdict), pixel_aspect=aspect, about=about)

    def _prediction(self, query: int) -> str:
        return self._database.names[self._ranked.rows[query, 0]]

    def _candidate(self, query: int, rank: int, verdict: str) -> "Candidate":
        """The candidate at a rank from 0."""
        row, score = int(self._ranked.rows[query, rank]), self._ranked.scores[query, rank]
        place = int(np.flatnonzero(self._matched.candidates.indices[query] == row)[0])
        pair = jax.tree.map(lambda values: values[place], self._matched.matches[0][query])
        caption = f"{verdict}: {_short(self._database.names[row])}, rank {rank + 1}, score {score:.5g}"
        histogram = self.evaluation.histogram or HistogramOfShifts()
        return self._shown(row, caption, pair, explain(histogram, pair))

    def correct_candidates(self, query: int) -> list["Candidate"]:
        """The first correct candidate, or the correct image that retrieval missed; empty if there is none."""
        correct = self.evaluation.is_correct(self.evaluation.headline, self.place)
        positives, truth = self.evaluation.positives[self.place], self._sequence.truth
        if correct is None or positives is None or truth is None or not positives.counts[query]:
            return []
        if correct[query].any():
            return [self._candidate(query, int(np.argmax(correct[query])), "correct")]
        nearest, rows = truth.place(query), positives.of(query)
        row = nearest if nearest is not None and nearest in rows else int(rows[0])
        num_candidates = self._matched.candidates.indices.shape[1]
        caption = f"correct: {_short(self._database.names[row])}, not among the {num_candidates} candidates"
        return [self._shown(row, caption)]

    def _shown(self, row: int, caption: str, *matched: Any) -> "Candidate":
        from mfvpr.report.figures import Candidate

        return Candidate(self._resize(self._database.read(row)), caption, *matched)

    def _resize(self, image: np.ndarray) -> np.ndarray:
        extractor = self.evaluation.ranked.system.pipeline.extractor
        size = extractor.image_size
        return image if size is None else resize(image, size, extractor.interpolation)


def _short(name: str) -> str:
    return clip_middle(printable(name), _NAME_LENGTH)


def _pick_evenly(values: np.ndarray, number: int) -> list[int]:
    chosen = np.linspace(0, len(values) - 1, min(number, len(values))).round().astype(int)
    return values[chosen].tolist()
