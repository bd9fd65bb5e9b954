"""Our RANSAC beside OpenCV's on the same matches of real images: recall, and inliers pair by pair."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmark.real import matched_sets
from experiments.console import track
from mfvpr import Homography, OpenCvHomography, pipeline
from mfvpr.data.files import write_text
from mfvpr.evaluation import hits
from mfvpr.report.runs import versions
from mfvpr.report.tables import Table
from mfvpr.reranking import rank_shortlist
from mfvpr.results import Matched
from mfvpr.scoring import Scorer

CANDIDATES = 50
TOLERANCE = 2  # frames
THRESHOLDS = (8.0, 24.0)  # px


def run(rounds: int | None, out: Path, data: Path | None = None) -> None:
    """Both data sets below `data`, SIFT's and ALIKED n16's matches; `rounds` seeds of ours."""
    rows = [row for name, matched in matched_sets(data, CANDIDATES) for row in compared(name, matched, rounds or 4)]
    print(f"\n{_table([*rows, *pooled(rows)]).text()}\n")
    write_text(out, json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
    print(f"results: {out}")


def compared(name: str, matched: Matched, seeds: int) -> Iterator[dict[str, Any]]:
    """By threshold: queries that OpenCV and ours, by seed, answer right, and the difference of the pairs' inliers."""
    for threshold in THRESHOLDS:
        plain = Homography(threshold)
        refit = replace(plain, refit=True)  # counts what OpenCV 5 counts: inliers of the last least squares
        scorers = {"OpenCV": OpenCvHomography(threshold), "refit": refit}
        scorers |= {f"seed {seed}": replace(plain, seed=seed) for seed in range(seeds)}
        opencv, fitted, *ours = (_scores(matched, f"{threshold:g} px, {who}", one) for who, one in scorers.items())
        found = matched.candidates.mask
        difference, allowed = (fitted - opencv)[found], np.maximum(2, 0.05 * opencv[found])
        yield {
            "matches": name, "threshold": threshold, "queries": len(opencv),
            "opencv": _right(matched, opencv), "refit": _right(matched, fitted),
            "mfvpr": [_right(matched, scores) for scores in ours],
            "difference": [float(one) for one in np.percentile(difference, [2.5, 50, 97.5])],
            "close": float(np.mean(np.abs(difference) <= allowed)),
        }  # fmt: skip


def pooled(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The right answers of all data sets, by features and threshold."""
    kinds = dict.fromkeys((row["matches"].partition(", ")[2], row["threshold"]) for row in rows)
    for features, threshold in kinds:
        same = [row for row in rows if row["matches"].endswith(f", {features}") and row["threshold"] == threshold]
        summed = {key: sum(row[key] for row in same) for key in ("queries", "opencv", "refit")}
        by_seed = [sum(one) for one in zip(*(row["mfvpr"] for row in same), strict=True)]
        yield {"matches": f"all, {features}", "threshold": threshold, **summed, "mfvpr": by_seed}


def _scores(matched: Matched, label: str, scorer: Scorer) -> np.ndarray:
    [scores] = pipeline.score({label: scorer}, matched.by_scale, matched.candidates, track=track(label)).values()
    return scores


def _right(matched: Matched, scores: np.ndarray) -> int:
    """How many queries have a right image first."""
    candidates, truth = matched.candidates, matched.sequence.truth
    assert truth is not None  # of data sets whose order it is
    rows = np.take_along_axis(candidates.indices, rank_shortlist(candidates, scores), axis=1)
    return int(np.sum(hits(rows, truth.positives(TOLERANCE))))


def _table(rows: list[dict[str, Any]]) -> Table:
    def recall(row: dict[str, Any], right: int) -> str:
        return f"{100 * right / row['queries']:.1f}"

    def cells(row: dict[str, Any]) -> list[str]:
        seeds = [recall(row, right) for right in sorted(row["mfvpr"])]
        low, middle, high = (f"{one:g}" for one in row["difference"]) if "difference" in row else ("", "", "")
        return [
            f"{row['matches']}, {row['threshold']:g} px", recall(row, row["opencv"]), f"{seeds[0]} .. {seeds[-1]}",
            recall(row, row["refit"]), middle, low and f"{low} .. {high}",
            f"{100 * row['close']:.1f}" if "close" in row else "",
        ]  # fmt: skip

    header = ["matches", "OpenCV", "mfvpr, seeds", "refit", "median", "95 %", "within 2 or 5 %"]
    return Table(header, [cells(row) for row in rows])
