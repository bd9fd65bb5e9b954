"""Dominant shifts between each query and its first prediction, with their intervals, as a file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.report.evaluations import EvaluationReport
from mfvpr.report.rankings import format_number, write_csv
from mfvpr.scoring.histogram import HistogramOfShifts

HEADER = ("query", "prediction", "shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "scale")


def write_shifts(
    folder: Path,
    evaluation: EvaluationReport,
    scorer: HistogramOfShifts,
    refused: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> None:
    """Write `shifts.csv` of every sequence: shifts of the headline's first predictions, candidate minus query, px.

    A line has the refined dominant shift of the query's middle in the images that the detector saw, its 95 % interval,
    and how much larger the candidate shows it; empty if no match votes. Features of several scales have no file.
    `refused` are queries of each sequence, which have no line; None = no query is refused.
    """
    names = evaluation.ranked.dataset.database.names
    sequences = zip(evaluation.ranked.matched, evaluation.ranked.systems[evaluation.headline], strict=True)
    for place, (matched, ranked) in enumerate(sequences):
        match_set = matched.by_scale
        if isinstance(match_set, Scales):
            continue
        predictions = ranked.rows[:, 0]
        has_prediction = predictions >= 0
        queries = np.flatnonzero(has_prediction if refused is None else has_prediction & ~refused[place])
        places = np.argmax(matched.candidates.indices[queries] == predictions[queries, None], axis=1)
        shifts, intervals, scales = dominant_shifts(scorer, match_set, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), scales[:, None]], axis=1)
        lines = [
            [matched.sequence.images.names[query], names[predictions[query]],
             *("" if np.isnan(value) else format_number(value) for value in row)]
            for query, row in zip(queries, numbers, strict=True)
        ]  # fmt: skip
        write_csv(evaluation.folder(folder, place) / "shifts.csv", HEADER, lines)
