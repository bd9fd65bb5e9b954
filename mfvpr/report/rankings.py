"""Rankings as files: the predictions for each query, and the failures."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.utils.files import replacing

NO_PLACE = "no place"  # the prediction for a query whose place the database does not seem to show


@dataclass(frozen=True)
class Rankings:
    """Rankings of one system.

    Attributes:
        queries: names of Q images.
        database: names of N images.
        rows: of the database, best first, -1 = none.
        scores: in that order.
        correct: in that order; None = unknown.
        refused: queries with the prediction `NO_PLACE`; None = none.
    """

    queries: Sequence[str]
    database: Sequence[str]
    rows: Int[np.ndarray, "queries candidates"]
    scores: Float[np.ndarray, "queries candidates"]
    correct: Bool[np.ndarray, "queries candidates"] | None
    refused: Bool[np.ndarray, " queries"] | None = None


def write_predictions(path: Path, rankings: Rankings) -> None:
    """Write a CSV line per query and candidate, best first: `query,rank,database,score,correct`.

    `correct` is 1 or 0, or empty where it is unknown. A query that is refused has one line, `NO_PLACE`, with score and
    `correct` of its first candidate.
    """
    refused = np.zeros(len(rankings.rows), bool) if rankings.refused is None else rankings.refused
    lines = (
        [rankings.queries[query], rank + 1, NO_PLACE if refused[query] else rankings.database[row],
         format_number(rankings.scores[query, rank]) if row >= 0 else "",
         "" if rankings.correct is None else int(rankings.correct[query, rank])]
        for (query, rank), row in np.ndenumerate(rankings.rows)
        if (rank == 0 if refused[query] else row >= 0)
    )  # fmt: skip
    write_csv(path, ("query", "rank", "database", "score", "correct"), lines)


def write_failures(path: Path, rankings: Rankings) -> None:
    """Write `query,prediction,rank,correct_image,score,margin` of the queries whose top prediction is incorrect.

    `rank`, `correct_image` and `score` are of the first correct candidate, empty where there is none; `margin` is how
    much higher the first prediction scores, refused or not. Nothing is written without ground truth.
    """
    if rankings.correct is None:
        return
    lines = []
    for query in map(int, np.flatnonzero(~rankings.correct[:, 0])):
        names = [rankings.database[row] if row >= 0 else "" for row in rankings.rows[query]]
        correct, scores = rankings.correct[query], rankings.scores[query]
        rank = int(np.argmax(correct))
        with np.errstate(invalid="ignore"):  # of two infinite scores
            margin = scores[0] - scores[rank]
        numbers = [format_number(value) for value in (scores[rank], margin)]
        first_correct = [rank + 1, names[rank], *numbers] if correct.any() else [""] * 4
        lines.append([rankings.queries[query], names[0], *first_correct])
    write_csv(path, ("query", "prediction", "rank", "correct_image", "score", "margin"), lines)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a file of `write_csv` by column."""
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        return [*csv.DictReader(file)]


def format_number(value: Any) -> str:
    """A number in a CSV file."""
    return f"{value:.7g}"


def write_csv(path: Path, header: Sequence[str], lines: Iterable[Sequence[str | int]]) -> None:
    """Write names as the very bytes that the file system has, so that they can be looked up again.

    A spreadsheet may take a name that begins with `=`, `+`, `-` or `@` for a formula: import such columns as text.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", errors="surrogateescape") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *lines])
