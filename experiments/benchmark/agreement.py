"""Our RANSAC beside OpenCV's on the same matches of real images: recall, and inliers pair by pair."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import answered, extractors, matched_sets
from experiments.console import track
from mfvpr import Homography, OpenCvHomography
from mfvpr.evaluation import stages
from mfvpr.report import Table
from mfvpr.reranking import Matched
from mfvpr.scoring import Scorer
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

CANDIDATES = 50
TOLERANCE = 2  # frames
THRESHOLDS = (8.0, 24.0)  # px


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Both data sets below `data`, SIFT's and ALIKED n16's matches; `rounds` (at least 2) seeds of ours."""
    rows = [
        row
        for name, matched in matched_sets(data, CANDIDATES, extractors())
        for row in compared(name, matched, max(rounds or 4, 2))
    ]
    print(f"\n{_table([*rows, *pooled(rows)]).text()}\n")
    write_text(out, json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
    print(f"results: {out}")


def compared(name: str, matched: Matched, seeds: int) -> Iterator[dict[str, Any]]:
    """By threshold: queries that OpenCV and ours, by seed, answer right, and the difference of the pairs' inliers."""
    for threshold in THRESHOLDS:
        opencv = _scores(matched, f"{threshold:g} px, OpenCV", OpenCvHomography(threshold))
        plain, refit = (
            [
                _scores(matched, f"{threshold:g} px, seed {seed}", Homography(threshold, refit=fitted, seed=seed))
                for seed in range(seeds)
            ]
            for fitted in (False, True)
        )
        some = matched.candidates.mask
        # Refitted, since OpenCV 5 counts the inliers of its last least squares.
        difference, allowed = (refit[0] - opencv)[some], np.maximum(2, 0.05 * opencv[some])
        yield {
            "matches": name, "threshold": threshold, "queries": len(opencv),
            "opencv": _right(matched, opencv), "mfvpr": [_right(matched, scores) for scores in plain],
            "refit": [_right(matched, scores) for scores in refit],
            "difference": [float(one) for one in np.percentile(difference, [2.5, 50, 97.5])],
            "close": float(np.mean(np.abs(difference) <= allowed)),
        }  # fmt: skip


def pooled(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The right answers of all data sets, by features and threshold."""
    kinds = dict.fromkeys((row["matches"].partition(", ")[2], row["threshold"]) for row in rows)
    for features, threshold in kinds:
        same = [row for row in rows if row["matches"].endswith(f", {features}") and row["threshold"] == threshold]
        summed = {key: sum(row[key] for row in same) for key in ("queries", "opencv")}
        by_seed = {key: np.sum([row[key] for row in same], axis=0).tolist() for key in ("mfvpr", "refit")}
        yield {"matches": f"all, {features}", "threshold": threshold, **summed, **by_seed}


def _scores(matched: Matched, label: str, scorer: Scorer) -> np.ndarray:
    [scores] = stages.score({label: scorer}, matched.by_scale, matched.candidates, track=track(label)).values()
    return scores


def _right(matched: Matched, scores: np.ndarray) -> int:
    """How many queries have a right image first."""
    return int(answered(matched, scores, TOLERANCE).sum())


def _table(rows: list[dict[str, Any]]) -> Table:
    def recall(row: dict[str, Any], right: float) -> str:
        return f"{100 * right / row['queries']:.1f}"

    def range_of(row: dict[str, Any], who: str) -> str:
        low, *_, high = sorted(row[who])
        return f"{recall(row, float(np.mean(row[who])))} ({recall(row, low)} .. {recall(row, high)})"

    def cells(row: dict[str, Any]) -> list[str]:
        low, middle, high = (f"{one:g}" for one in row["difference"]) if "difference" in row else ("", "", "")
        return [
            f"{row['matches']}, {row['threshold']:g} px", recall(row, row["opencv"]), range_of(row, "mfvpr"),
            range_of(row, "refit"), middle, low and f"{low} .. {high}",
            f"{100 * row['close']:.1f}" if "close" in row else "",
        ]  # fmt: skip

    header = ["matches", "OpenCV", "mfvpr", "mfvpr, refit", "median", "95 %", "within 2 or 5 %"]
    return Table(header, [cells(row) for row in rows])
