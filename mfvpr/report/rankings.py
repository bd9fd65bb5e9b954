"""Rankings as files: the predictions for each query, the failures, and the images that could not be used."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from mfvpr.evaluation.results import RankedDataset
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.file_names import file_names
from mfvpr.report.tables import Table, format_number, write_csv
from mfvpr.reranking.results import Ranked
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
    """Write a CSV line per query and candidate, best first: `query,rank,database,score,correct`.

    `correct` is 1 or 0, or empty where it is unknown. A query that is refused has one line, `NO_PLACE`, with score and
    `correct` of its first candidate.
    """
    refused = np.zeros(len(queries), bool) if refused is None else refused
    lines = (
        [queries[query], rank + 1, NO_PLACE if refused[query] else database[row],
         format_number(ranked.scores[query, rank]) if row >= 0 else "",
         "" if correct is None else int(correct[query, rank])]
        for (query, rank), row in np.ndenumerate(ranked.rows)
        if (rank == 0 if refused[query] else row >= 0)
    )  # fmt: skip
    write_csv(path, ("query", "rank", "database", "score", "correct"), lines)


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
