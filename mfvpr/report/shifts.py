"""How far each query's image is from its first answer's: a file of dominant shifts with their intervals."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.report.evaluations import Judged
from mfvpr.report.rankings import number, write_csv
from mfvpr.scoring.histogram import HistogramOfShifts

HEADER = ("query", "answer", "shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "scale")


def write_shifts(
    folder: Path, judged: Judged, scorer: HistogramOfShifts, refused: Sequence[np.ndarray] | None = None
) -> None:
    """`shifts.csv` of every sequence, of the first answers of the system that decides: candidate minus query, px.

    How far the answer shows the middle of the query from there, by the refined dominant shift in the images that the
    detector saw, its 95 % interval, and how much larger it shows it; empty where nothing votes. Of features of several
    scales there is none.

    Args:
        folder: of the run.
        judged: whose first answers are taken.
        scorer: whose histogram is taken.
        refused: `[Q]` bool of each sequence, what is not answered, and has no line; None = none.
    """
    names = judged.result.dataset.database.names
    sequences = zip(judged.result.matched, judged.result.systems[judged.headline], strict=True)
    for place, (matched, ranked) in enumerate(sequences):
        match_set = matched.by_scale
        if isinstance(match_set, Scales):
            continue
        answers = ranked.rows[:, 0]
        given = answers >= 0
        queries = np.flatnonzero(given if refused is None else given & ~refused[place])
        places = np.argmax(matched.candidates.indices[queries] == answers[queries, None], axis=1)
        shifts, intervals, scales = dominant_shifts(scorer, match_set, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), scales[:, None]], axis=1)
        lines = [
            [matched.sequence.images.names[query], names[answers[query]],
             *("" if np.isnan(value) else number(value) for value in row)]
            for query, row in zip(queries, numbers, strict=True)
        ]  # fmt: skip
        write_csv(judged.folder(folder, place) / "shifts.csv", HEADER, lines)
