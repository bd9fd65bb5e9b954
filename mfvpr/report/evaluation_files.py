"""Files of rankings: predictions, failures, unusable images, hits by query, and tests of every two systems."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mfvpr.datasets.positives import stack_positives
from mfvpr.evaluation.dataset_ranking import RankedDataset
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.selection import places_along_path
from mfvpr.evaluation.sequences import DriveFilter
from mfvpr.evaluation.statistics import McNemar, PathTest, mcnemar, path_test
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.runs import file_names
from mfvpr.report.tables import Table, format_number, write_csv
from mfvpr.utils.files import write_text

NO_PLACE = "no place"  # the prediction for a query whose place the database does not seem to show


def write_rankings(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `predictions/` and `failures/` of every system, those of the headline's into the folder itself.

    Only there, queries of low confidence have the prediction `NO_PLACE`.
    """
    database, files = evaluation.ranked.dataset.database.names, file_names([*evaluation.ranked.systems])
    for place, sequence in enumerate(evaluation.sequences):
        target, names = evaluation.folder(folder, place), (sequence.images.names, database)
        for name, parts in evaluation.ranked.systems.items():
            ranked, correct = parts[place], evaluation.is_correct(name, place)
            write_predictions(target / "predictions" / f"{files[name]}.csv", *names, ranked, correct)
            write_failures(target / "failures" / f"{files[name]}.csv", *names, ranked, correct)
            if name == evaluation.headline:
                write_failures(target / "failures.csv", *names, ranked, correct)
                write_predictions(target / "predictions.csv", *names, ranked, correct, evaluation.refused[place])


def write_predictions(
    path: Path,
    queries: Sequence[str],
    database: Sequence[str],
    ranked: Ranked,
    correct: Bool[np.ndarray, "queries candidates"] | None,
    refused: Bool[np.ndarray, " queries"] | None = None,
) -> None:
    """Write a CSV line per query and candidate, best first: `query,rank,database,score,correct,refused`.

    `correct` is 1 or 0, or empty where it is unknown. A query that is refused has one line, `NO_PLACE`, with score and
    `correct` of its first candidate, and its name in `refused`.
    """
    refused = np.zeros(len(queries), bool) if refused is None else refused
    lines = (
        [queries[query], rank + 1, NO_PLACE if refused[query] else database[row],
         format_number(ranked.scores[query, rank]) if row >= 0 else "",
         "" if correct is None else int(correct[query, rank]),
         database[row] if refused[query] and row >= 0 else ""]
        for (query, rank), row in np.ndenumerate(ranked.rows)
        if (rank == 0 if refused[query] else row >= 0)
    )  # fmt: skip
    write_csv(path, ("query", "rank", "database", "score", "correct", "refused"), lines)


def write_failures(
    path: Path,
    queries: Sequence[str],
    database: Sequence[str],
    ranked: Ranked,
    correct: Bool[np.ndarray, "queries candidates"] | None,
) -> None:
    """Write `query,prediction,rank,correct_image,score,margin` of the queries whose top prediction is incorrect.

    `rank`, `correct_image` and `score` are of the first correct candidate, empty where there is none; `margin` is how
    much higher the first prediction scores, refused or not. Nothing is written without ground truth.
    """
    if correct is None:
        return
    lines = []
    for query in map(int, np.flatnonzero(~correct[:, 0])):
        names = [database[row] if row >= 0 else "" for row in ranked.rows[query]]
        rank, scores = int(np.argmax(correct[query])), ranked.scores[query]
        with np.errstate(invalid="ignore"):  # of two infinite scores
            numbers = [format_number(value) for value in (scores[rank], scores[0] - scores[rank])]
        first_correct = [rank + 1, names[rank], *numbers] if correct[query].any() else [""] * 4
        lines.append([queries[query], names[0], *first_correct])
    write_csv(path, ("query", "prediction", "rank", "correct_image", "score", "margin"), lines)


def write_skipped(folder: Path, ranked: RankedDataset) -> None:
    """Write `skipped.csv` with images that could not be used and the reasons, if there are any."""
    names = ranked.dataset.database.names
    bad_rows = {bad for matched in ranked.matched for bad in matched.bad_database.items()}
    lines = sorted(("database", names[row], reason) for row, reason in bad_rows)
    lines += [("queries", matched.sequence.images.names[row], reason)
              for matched in ranked.matched for row, reason in matched.bad_queries.items()]  # fmt: skip
    if lines:
        write_text(folder / "skipped.csv", Table(["folder", "image", "reason"], lines).csv())


def write_changes(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `changes.csv` with the queries whose first prediction a sequence changes, if the system has sequences.

    `correct_before` and `correct_after` are 1 or 0, or empty where it is unknown.
    """
    sequences = {name: score.base for name, score in evaluation.ranked.system.final_scores.items()
                 if isinstance(score.step, DriveFilter)}  # fmt: skip
    lines = []
    for name, base in sequences.items():
        for place, sequence in enumerate(evaluation.sequences):
            before, after = (_first_predictions(evaluation, system, place) for system in (base, name))
            lines += [
                [name, sequence.name, image, *alone, *together]
                for image, alone, together in zip(sequence.images.names, before, after, strict=True)
                if alone[0] != together[0]
            ]
    if sequences:
        header = ["system", "sequence", "query", "before", "correct_before", "after", "correct_after"]
        write_csv(folder / "changes.csv", header, lines)


def _first_predictions(evaluation: EvaluationReport, system: str, place: int) -> list[tuple[str, str]]:
    """Name of the first prediction of each query of a sequence, and whether it is correct: 1, 0, or empty."""
    rows, correct = evaluation.ranked.systems[system][place].rows[:, 0], evaluation.is_correct(system, place)
    flags = [""] * len(rows) if correct is None else [str(int(flag)) for flag in correct[:, 0]]
    names = evaluation.ranked.dataset.database.names
    return [(names[int(row)] if row >= 0 else "", flag) for row, flag in zip(rows, flags, strict=True)]


class Difference(NamedTuple):
    """Tests of two systems on the first predictions of all queries of all sequences."""

    first: str
    second: str
    mcnemar: McNemar
    path: PathTest

    @property
    def cells(self) -> list[str]:
        """A line of `differences.csv`."""
        counts = self.mcnemar
        numbers = map(format_number, (counts.p_value, *self.path))
        return [self.first, self.second, str(counts.only_first), str(counts.only_second), *numbers]


def differences(evaluation: EvaluationReport) -> list[Difference]:
    """Tests of every two systems, in their order, with ground truth."""
    path = np.argsort(_places(evaluation), kind="stable")
    hits = {name: evaluation.hits(name)[path] for name in evaluation.ranked.systems}
    return [
        Difference(first, second, mcnemar(hits[first], hits[second]), path_test(hits[first], hits[second]))
        for first, second in itertools.combinations(hits, 2)
    ]


def _places(evaluation: EvaluationReport) -> np.ndarray:
    """`[Q]` places of all queries along the map; those of one sequence without positions are in their order."""
    truth = evaluation.sequences[0].truth
    if truth is None or (len(evaluation.sequences) == 1 and truth.unit != "m"):
        return np.arange(evaluation.num_queries)
    known = [positives for positives in evaluation.positives if positives is not None]
    return places_along_path(stack_positives(known), truth.unit)


def write_gains(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, `differences.csv` and `differences.md`; nothing without ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need.
    """
    if not evaluation.thresholds:
        return
    systems, places = [*evaluation.ranked.systems], evaluation.by_sequence(_places(evaluation))
    header = ["query", "place", *(column for name in systems for column in (name, f"{name} rank"))]
    for part, sequence in enumerate(evaluation.sequences):
        columns = [sequence.images.names, places[part].tolist()]
        for name in systems:
            correct = np.asarray(evaluation.is_correct(name, part), bool)
            ranks = np.where(correct.any(axis=1), np.argmax(correct, axis=1) + 1, 0)
            columns += [correct[:, 0].astype(int).tolist(), [rank or "" for rank in ranks.tolist()]]
        write_csv(evaluation.folder(folder, part) / "gains.csv", header, zip(*columns, strict=True))
    tests, counts = differences(evaluation), {}
    for first, second, test, path in tests:
        counts[first, second] = f"{test.only_first} (p {path.p_value:.2g})"
        counts[second, first] = f"{test.only_second} (p {path.p_value:.2g})"
    rows = [[name, *(counts.get((name, other), "") for other in systems)] for name in systems]
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "design_effect", "path_p"]
    write_csv(folder / "differences.csv", header, [test.cells for test in tests])
    write_text(folder / "differences.md", Table(["only this is correct, not", *systems], rows).markdown())
