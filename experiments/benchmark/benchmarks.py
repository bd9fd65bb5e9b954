"""Times mfvpr against other implementations of the same computation.

All implementations of a step run in turns after a warm-up, so that other load on the machine slows them all alike.
"""

import os
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.benchmark import localize, networks, scores
from experiments.benchmark.accelerator_checks import check_all
from experiments.benchmark.harness import Entry, Rows, measure, write_report
from mfvpr.cli.programs import Parser, run_command
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT
from mfvpr.utils.files import require_replaceable

PAIRS, TINY = (50, 700, 512), (3, 64, 32)  # candidates, keypoints, dimensions
GRID: dict[str, Any] = {"sigma": (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), "bin_size": (5.0, 10.0, 15.0, 20.0)}  # px
WEIGHTED_GRID = GRID | {"weight": ("fs", "dmf", "unit"), "max_distance": (0.5, 0.8, 1.1, 1.4)}
GRIDS = {"6 x 4 histograms": GRID, "6 x 4 x 3 weights x 4 distances": WEIGHTED_GRID}
THOUSAND = {"sigma": np.linspace(8, 40, 25), "bin_size": np.array([10.0, 15.0])}
THOUSAND |= {"weight": ("fs", "unit"), "max_distance": np.linspace(0.5, 1.4, 10)}
PLACES = {"same place": 0.9, "other place": 0.0}  # shares of the matches that agree
SWEPT = 50, 256, 256  # pairs, slots, matches

Group = Callable[[int], Rows]  # takes the number of rounds


def timed(entries: Callable[..., list[Entry]], *sizes: tuple[Any, ...], small: Sequence[tuple[Any, ...]] = ()) -> Group:
    """Time entries of several sizes, and on a CPU of `small` ones, if any, which test the program only."""

    def measure_all(rounds: int) -> Rows:
        chosen = small if small and jax.default_backend() == "cpu" else sizes
        return measure([entry for each in chosen for entry in entries(*each)], rounds)

    return measure_all


# What each benchmark measures, timed calls of each implementation, and its groups of steps.
BENCHMARKS: dict[str, tuple[str, int, dict[str, Group]]] = {
    "scores": ("matching and scoring of one query with 50 candidates", 15, {
        "matching": timed(scores.matching_entries, PAIRS),
        "queries": timed(scores.ranking_entries, (1, *PAIRS)),
        "scores": timed(scores.scoring_entries, (50,)),
        "shifts": timed(scores.shift_entries, ()),
    }),
    "search": ("nearest global descriptors of 1, 20 and 100 queries among 10,000 and 100,000; 6 GB", 5, {
        "search": timed(scores.search_entries, *product((10_000, 100_000), (512, 4096), [(1, 20, 100)])),
    }),
    "sweeps": ("grids of a score's parameters on cached matches", 7, {
        "grids": timed(scores.grid_entries, *((f"{grid}, {place}", GRIDS[grid], *SWEPT, PLACES[place])
                                              for place, grid in product(PLACES, GRIDS))),
        "anchors": timed(scores.anchor_entries, *((cells, *SWEPT, PLACES["same place"]) for cells in (10, 15, 20))),
    }),
    "networks": ("D2-Net, MixVPR, ALIKED beside torch; NetVLAD, Patch-NetVLAD, ResNet-50, SelaVPR; 30 min", 5, {
        "networks": timed(networks.network_entries, (networks.CONTESTS, (1, 8))),
    }),
    "accelerator": ("correct and fast on a GPU? All steps beside torch there; on a CPU tiny", 10, {
        "correct": check_all,
        "rates": timed(scores.product_entries, (8192,), small=[(256,)]),
        "matching": timed(scores.matching_entries, PAIRS, (1000, 1000, 128), small=[TINY]),
        "scores": timed(scores.scoring_entries, (50,), (1000,), (10_000,), small=[(4,)]),
        "grids": timed(scores.grid_entries, ("1,000 settings", THOUSAND, 5000), small=[("settings", THOUSAND, 2)]),
        "search": timed(scores.search_entries, (1_000_000, 512, (1, 100, 1000)), small=[(2000, 16, (3,))]),
        "networks": timed(networks.network_entries, (networks.ON_ACCELERATOR, (1, 8)),
                          small=[(networks.ON_ACCELERATOR, (1,))]),
        "queries": timed(scores.ranking_entries, (1, *PAIRS), (1000, *PAIRS), small=[(1, *TINY), (3, *TINY)]),
    }),
    "localize": ("maps of 1,000 and 10,000 images: time from image file to prediction", 3, {
        "maps": localize.measure_maps,
    }),
}  # fmt: skip


def main() -> None:
    """Run the chosen benchmark."""
    run_command("python -m experiments.benchmark", str(__doc__), add_arguments)


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    lines = [f"  {name:<12} {about} ({rounds} rounds)" for name, (about, rounds, _) in BENCHMARKS.items()]
    parser.epilog = "\n".join(["benchmarks:", *lines])
    parser.add_argument("benchmark", nargs="?", choices=BENCHMARKS, default="scores", help="default: scores")
    parser.add_argument("groups", nargs="*", help="groups of steps, in this order (default: all of the benchmark)")
    parser.add_argument("--rounds", type=int, help="timed calls of each implementation (default: see below)")
    parser.add_argument("--out", type=Path, help="JSON file to write (default: runs/benchmark_BENCHMARK.json)")
    parser.set_defaults(run="experiments.benchmark.benchmarks:run")


def run(benchmark: str, groups: list[str], rounds: int | None, out: Path | None) -> None:
    """Run groups of a benchmark; print a table after each, and write all tables so far as JSON to `out`."""
    (COUNT | None).check("--rounds", rounds)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # leaves torch its part of a GPU
    _, usual_rounds, known = BENCHMARKS[benchmark]
    if unknown := {*groups} - {*known}:
        raise InputError(f"groups: expected some of {', '.join(known)}, got {', '.join(sorted(unknown))}")
    out, report = out or Path(f"runs/benchmark_{benchmark}.json"), {}
    require_replaceable(out, b'{\n "machine": {')
    for group in groups or known:
        report[group] = known[group](rounds or usual_rounds)
        write_report(out, report)
