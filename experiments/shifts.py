"""Shifts of correct pairs on synthetic streets, whose true shifts are known: their errors, and their 95 % intervals.

    python -m experiments.shifts DIR --seeds 1 2 --lane 2 --features aliked --size auto 320x320

Query i and database image i show the same place. Streets, at `--shape`, and features are kept in DIR. With `--lane 2`,
queries are twice as far beside the lane of the database: near things then move more against far things. The true shift
is the median over all that both images show.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float

from mfvpr import HistogramOfShifts, Shortlist
from mfvpr.cli.command_line import load_system
from mfvpr.cli.programs import Parser, run_command
from mfvpr.datasets import folder
from mfvpr.datasets.streets import TRUTH
from mfvpr.datasets.streets.drawing import SPACING, Drive, draw_drives, plan_drives
from mfvpr.datasets.streets.scene import LANE
from mfvpr.evaluation import System
from mfvpr.evaluation.stages import dominant_shifts, match
from mfvpr.evaluation.system import folders_of
from mfvpr.report import Table
from mfvpr.storage import FeatureCache

FRAMES = 50  # of a drive
GOOD, WIDTH = 35, 1024  # px off that count as good, in an image of this width

Shifts = tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, "pairs 2 2"], Float[np.ndarray, "pairs 2"]]


def draw(root: Path, seed: int, lane: float, shape: tuple[int, int]) -> Path:
    """The folder of a street by day and of a drive beside the lane, at night and in snow; drawn if it is missing."""
    street = root / f"lane{lane:g}-seed{seed}-{shape[0]}x{shape[1]}"
    if not street.exists():
        database, queries = plan_drives(seed, FRAMES, shape)
        queries = [replace(camera, x=LANE + lane * (camera.x - LANE)) for camera in queries]
        weathers = [weather for weather in ("night", "snow") for _ in range(FRAMES // 2)]
        drives = [Drive(street / "database", database, ["day"] * FRAMES, (seed, 7)),
                  Drive(street / "queries", queries, weathers, (seed, 8), street / TRUTH)]  # fmt: skip
        draw_drives(drives, seed, SPACING * FRAMES)
    return street


def measure(street: Path, system: System, cache: FeatureCache) -> Shifts:
    """Shifts of query i in database image i, their intervals (low, high), and true shifts, in shares of the sides."""
    dataset = folder(street / "database", street / "queries", ground_truth="order")
    system = system.fit_image_size(folders_of(dataset), print)
    pipeline, scorer = system.pipeline, cast(HistogramOfShifts, system.scorers["histogram"])
    [queries], [database] = (cache.local(images, pipeline.extractor) for images in (dataset.queries, dataset.database))
    rows = np.arange(FRAMES, dtype=np.int32)
    same_places = Shortlist(rows[:, None], np.ones((FRAMES, 1), np.float32), np.ones((FRAMES, 1), bool))
    matches = match(queries, database, same_places, pipeline.matcher)
    shifts, intervals, sizes = dominant_shifts(scorer, matches, rows, np.zeros_like(rows))
    truth = np.loadtxt(street / TRUTH, delimiter=",", skiprows=1, usecols=(2, 3))
    return shifts / sizes, intervals / sizes[:, None], truth / dataset.database.read(0).shape[1::-1]


def row(parts: Sequence[Shifts]) -> list[str]:
    """Errors along x of all parts, coverage of the intervals along x and y, and their width along x."""
    shifts, intervals, truth = map(np.concatenate, zip(*parts, strict=True))
    errors = WIDTH * np.abs(shifts - truth)[:, 0]
    coverage = np.mean((intervals[:, 0] <= truth) & (truth <= intervals[:, 1]), axis=0)
    width = WIDTH * np.nanmedian(intervals[:, 1, 0] - intervals[:, 0, 0])
    shares = (100 * share for share in (np.mean(errors <= GOOD), *coverage))
    return [f"{np.nanmedian(errors):.1f}", *(f"{share:.0f}" for share in shares), f"{width:.0f}"]


def run(root: Path, seeds: list[int], lane: float, shape: str, features: str, size: list[str]) -> None:
    """Print a table with a row for each image size, over all seeds."""
    width, height = map(int, shape.split("x"))
    streets, rows = [draw(root, seed, lane, (width, height)) for seed in seeds], []
    for text in size:
        image_size = [*map(int, text.split("x"))] if "x" in text else text
        system = load_system("steering", features=features, **{"features.image_size": image_size})
        rows.append([features, text, *row([measure(street, system, FeatureCache(root)) for street in streets])])
    header = ["features", "px", "median error", f"within {GOOD} px", "x in interval", "y in interval", "its width"]
    print(Table(header, rows, 2).markdown())


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    parser.add_argument("root", metavar="DIR", type=Path, help="of the streets and their features")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2], help="of the streets")
    parser.add_argument("--lane", type=float, default=1, help="distance of the queries to the lane, of the usual one")
    parser.add_argument("--shape", default="448x336", help="of the images, px")
    parser.add_argument("--features", default="aliked", choices=("aliked", "xfeat", "sift"))
    parser.add_argument("--size", nargs="+", default=["auto"], help="features.image_size: auto, WIDTHxHEIGHT, ...")
    parser.set_defaults(run="experiments.shifts:run")


if __name__ == "__main__":
    run_command("python -m experiments.shifts", str(__doc__), add_arguments)
