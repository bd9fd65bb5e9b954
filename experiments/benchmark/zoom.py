"""The histogram's vote over several scales: recall where the right image is near, and where the database is thinned."""

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import answered, extractors, matched_sets
from mfvpr import HistogramOfShifts
from mfvpr.evaluation import stages
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.scoring.weights import WEIGHTS
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

SCALES = (0.7, 0.84, 0.92, 1.0, 1.09, 1.19, 1.41)
THINNED = {1: 2, 4: 2, 8: 4}  # every so manieth image of the database, and the tolerance, frames
SCORERS = {
    f"{weight}{what}": HistogramOfShifts(weight=WEIGHTS[weight], **options)
    for weight in ("fs", "ratio")
    for what, options in {
        "": {},
        ", 7 scales": {"scales": SCALES},
        ", 7 scales, prior": {"scales": SCALES, "scale_deviation": 0.5},
    }.items()
}  # fmt: skip


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Streets and both data sets below `data`, SIFT's and ALIKED n16's matches; `rounds` calls are timed."""
    rows = []
    for name, matched in matched_sets(data, "all", extractors(), streets=True):
        rows += [{"matches": name, **row} for row in judged(matched, rounds or 1)]
    print(f"\n{_table(rows).text()}\n")
    write_text(out, json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
    print(f"results: {out}")


def judged(matched: Matched, rounds: int) -> Iterator[dict[str, Any]]:
    """By scorer: recall by how thin the database is, and milliseconds per query."""
    for name, scorer in SCORERS.items():
        taken = []
        for _ in range(1 + rounds):  # the first compiles
            start = time.perf_counter()
            [scores] = stages.score({name: scorer}, matched.by_scale, matched.candidates).values()
            taken.append(1e3 * (time.perf_counter() - start) / len(scores))
        recall = [recall_of(matched, scores, every, tolerance) for every, tolerance in THINNED.items()]
        yield {"scorer": name, "recall": recall, "ms_per_query": float(np.median(taken[1:]))}


def recall_of(matched: Matched, scores: np.ndarray, every: int, tolerance: int) -> float:
    """R@1 among the images of the database whose number is a multiple of `every`."""
    return float(np.mean(answered(matched, scores, tolerance, matched.candidates.indices % every == 0)))


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    header = [
        "matches",
        "histogram",
        *(f"every {every}, ±{tolerance}" for every, tolerance in THINNED.items()),
        "ms/query",
    ]
    lines = [
        [row["matches"], row["scorer"], *(f"{100 * one:.1f}" for one in row["recall"]), f"{row['ms_per_query']:.1f}"]
        for row in rows
    ]
    return Table(header, lines, text_columns=2)
