"""How far each query's image is from its first answer's: a file of dominant shifts with their intervals."""

from pathlib import Path

import numpy as np

from mfvpr.pipeline import Scales, dominant_shifts
from mfvpr.report.evaluations import Judged
from mfvpr.report.rankings import number, write_csv
from mfvpr.scoring import HistogramOfShifts

HEADER = ("query", "answer", "shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y")


def write_shifts(folder: Path, judged: Judged, scorer: HistogramOfShifts) -> None:
    """`shifts.csv` of every sequence, of the first answers of the system that decides: candidate minus query, px.

    The refined dominant shift in the images that the detector saw, and its 95 % interval; empty where nothing matches.
    Of features of several scales there is none.

    Args:
        folder: of the run.
        judged: whose first answers are taken.
        scorer: whose histogram is taken.
    """
    names = judged.result.dataset.database.names
    sequences = zip(judged.result.matched, judged.result.systems[judged.headline], strict=True)
    for place, (matched, ranked) in enumerate(sequences):
        match_set = matched.by_scale
        if isinstance(match_set, Scales):
            continue
        answers = ranked.rows[:, 0]
        queries = np.flatnonzero(answers >= 0)
        places = np.argmax(matched.candidates.indices[queries] == answers[queries, None], axis=1)
        shifts, intervals = dominant_shifts(scorer, match_set, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4)], axis=1)
        lines = [
            [matched.sequence.images.names[query], names[answers[query]],
             *("" if np.isnan(value) else number(value) for value in row)]
            for query, row in zip(queries, numbers, strict=True)
        ]  # fmt: skip
        write_csv(judged.folder(folder, place) / "shifts.csv", HEADER, lines)
