"""The dominant shift of the same place on drawn streets, whose true shift is known: its error, and its interval."""

import csv
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import build
from experiments.console import tell
from mfvpr import HistogramOfShifts, Matches, RatioWeight, Shortlist
from mfvpr.datasets import folder_dataset
from mfvpr.datasets.streets import streets_folder
from mfvpr.evaluation import stages
from mfvpr.features import Extractor, Sift
from mfvpr.report import Table
from mfvpr.storage import Archive
from mfvpr.utils.files import write_text
from mfvpr.utils.versions import versions

LEVELS = (0.68, 0.95)
GROSS = 45.0  # px off along an axis: two standard deviations of the paper's votes
SCORERS = {
    "15 px bins, sigma 22.5": HistogramOfShifts(),
    "5 px bins, sigma 10": HistogramOfShifts(bin_size=5.0, sigma=10.0),
    "the same, 1 - ratio": HistogramOfShifts(bin_size=5.0, sigma=10.0, weight=RatioWeight()),  # of system=steering
}
FRAMES, SIZE = 100, (448, 336)  # of a street
SEEN = {"squashed": (336, 336), "as drawn": SIZE}  # what the detector gets


def run(rounds: int | None, out: Path) -> None:
    """SIFT's matches of every query with its own database image, on `rounds` streets with the seeds 0, 1, ..."""
    cache = build.expanded(os.environ.get("MFVPR_CACHE") or "~/.cache/mfvpr")  # as in conf/common.yaml
    rows = []
    for seed in range(rounds or 1):
        tell(f"street of seed {seed}")
        folder = streets_folder(cache, seed=seed, num_frames=FRAMES, image_size=SIZE)
        for image, size in SEEN.items():
            pairs = matched(folder, Sift(image_size=size), Archive(cache / "features"))
            rows += [{"seed": seed, "image": image, "histogram": name} | errors(scorer, *pairs)
                     for name, scorer in SCORERS.items()]  # fmt: skip
    print(f"\n{_table(rows).text()}")
    write_text(out, json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
    print(f"results: {out}")


def matched(folder: Path, extractor: Extractor, archive: Archive) -> tuple[Matches, np.ndarray]:
    """Matches `[Q, K, ...]` of every query with the database image of its place, and the true shifts `[Q, 2]`, px."""
    dataset = folder_dataset(folder / "database", folder / "queries", ground_truth="order")
    [queries], [database] = (archive.local(one, extractor, label="") for one in (dataset.queries, dataset.database))
    own = np.arange(len(queries))
    found = stages.match(
        queries,
        database,
        Shortlist(indices=own[:, None], scores=np.ones((len(own), 1)), mask=np.ones((len(own), 1), bool)),
    )
    with (folder / "ground_truth.csv").open(newline="") as file:
        drawn = np.array([[float(line["shift_x"]), float(line["shift_y"])] for line in csv.DictReader(file)])
    matches = found.pairs(own, np.zeros_like(own), found.capacity)
    return matches, drawn * matches.image_size1 / dataset.database.read(0).shape[1::-1]


def errors(scorer: HistogramOfShifts, matches: Matches, truth: np.ndarray) -> dict[str, Any]:
    """Of matches `[P, K, ...]` with true shifts `[P, 2]` the errors in px of the drawn image along x and y: medians and
    95 % of them, of the tallest bin and of the refined peak; the share of gross ones; how many intervals hold the true
    shift, and the median of their widths."""
    scorer = scorer.with_capacity(matches.image_size0, matches.image_size1)
    drawn = np.array(SIZE) / np.asarray(matches.image_size1)  # px of the drawn image in one of what the detector saw
    found: dict[str, Any] = {}
    for name, refine in (("bin", False), ("refined", True)):
        shifts = jax.vmap(partial(scorer.dominant_shift, refine=refine))(matches)
        off = np.abs(np.asarray(shifts) - truth) * drawn
        found[name] = {"median": np.median(off, axis=0).tolist(), "most": np.quantile(off, 0.95, axis=0).tolist(),
                       "gross": float(np.mean(off.max(axis=1) > GROSS))}  # fmt: skip
    for level in LEVELS:
        intervals = jax.vmap(partial(scorer.shift_interval, level=level))(matches)
        low, high = np.moveaxis(np.asarray(intervals), 1, 0)
        found[f"{level:g}"] = {"coverage": np.mean((low <= truth) & (truth <= high), axis=0).tolist(),
                               "width": np.median((high - low) * drawn, axis=0).tolist()}  # fmt: skip
    return found


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    def pair(values: Sequence[float], scale: float = 1.0) -> str:
        return " / ".join(f"{scale * value:.1f}" for value in values)

    columns = [(level, name, scale) for level in LEVELS for name, scale in (("coverage", 100), ("width", 1))]
    header = ["seed", "image", "histogram", "bin", "refined", "95 %", "gross %"]
    header += [f"{name} {100 * level:g} %" for level, name, _ in columns]
    lines = [
        [str(row["seed"]), row["image"], row["histogram"], pair(row["bin"]["median"]), pair(row["refined"]["median"]),
         pair(row["refined"]["most"]), f"{100 * row['refined']['gross']:.1f}",
         *(pair(row[f"{level:g}"][name], scale) for level, name, scale in columns)]
        for row in rows
    ]  # fmt: skip
    return Table(header, lines, text_columns=3)
