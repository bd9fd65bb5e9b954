"""Times mfvpr against the peers of the field, in one run.

Everything is warm; the contestants take turns, round by round, so that a noisy machine disturbs all alike.
"""

import argparse
import os
from importlib import import_module
from pathlib import Path

from experiments.errors import Parser, one_line
from experiments.launch import version

# Each is the module of this name, whose `run(rounds, out)` prints a table and writes it as JSON.
BENCHMARKS = {
    "scores": "matching and scoring of one query with 50 candidates (15 rounds)",
    "cells": "SSM-VPR's matching and score of 50 candidates (9 rounds)",
    "maps": "SelaVPR's and Patch-NetVLAD's re-ranking beside their products (7 rounds)",
    "homographies": "RANSAC of 50 pairs beside OpenCV's (7 rounds)",
    "agreement": "RANSAC on matches of real images beside OpenCV's: recall and inliers (4 seeds; half an hour)",
    "real": "all scores on the same matches of real images: recall with intervals, time per query (1 round)",
    "weights": "every score with every match weight on the same matches of real images: recall",
    "hubs": "scores divided by a database image's own with other places: recall on real images, choices on drawn ones",
    "fusions": "scores fused with the filter's in every way on the same matches: recall, and what each may lose",
    "zoom": "the histogram's vote over several scales, on real and drawn images: recall, time per query (1 round)",
    "shifts": "dominant shifts on drawn streets: errors and intervals in px (1 street)",
    "matchers": "LightGlue beside mutual neighbors on real images: recall by score, time per query (an hour at first)",
    "lightglue": "LightGlue of one query with 50 candidates, beside the public code in torch with --peer (3 rounds)",
    "sweeps": "grids of a score's parameters on cached matches (7 rounds)",
    "networks": "D2-Net, MixVPR, ALIKED, NetVLAD, Patch-NetVLAD, a generalized mean, SelaVPR (5 rounds; half an hour)",
    "localize": "maps of 1,000 and 10,000 images that are asked: time from file to answer (3 rounds)",
    "kills": "shards of evaluations that are killed: whether they end as undisturbed ones do (200 kills; 15 minutes)",
    "scale": "databases of 1,000 to 10,000 images on disk: time per query and peak memory (3 rounds)",
    "city": "100,000 images, features of the shortlists alone; what 2.8 million would take (3 rounds, 2 GB of disk)",
}


def main() -> None:
    """Run the chosen benchmark; only then is its module imported, so that --help need not wait for JAX."""
    parser = Parser(
        prog="python -m experiments.benchmark",
        description=__doc__,
        epilog="\n".join(["benchmarks:", *(f"  {name:<12} {about}" for name, about in BENCHMARKS.items())]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", nargs="?", choices=BENCHMARKS, default="scores", help="default: scores")
    parser.add_argument("--rounds", type=positive, help="timed calls of each contestant (default: see below)")
    parser.add_argument("--out", type=Path, help="JSON file to write (default runs/benchmark_WHAT.json)")
    parser.add_argument("--stores", type=Path, help="of scale: folder that keeps its features (default: 6 GB, deleted)")
    parser.add_argument(
        "--data",
        type=Path,
        help="of agreement, fusions, hubs, matchers, real, weights, zoom: folder with grief_season and corridor",
    )
    parser.add_argument("--peer", type=Path, help="of lightglue: a clone of https://github.com/cvg/LightGlue")
    parser.add_argument("--version", action="version", version=version(), help="print it and exit")
    arguments = parser.parse_args()
    with one_line():
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # leaves torch its part of a GPU
        own = {
            "stores": (["scale"], arguments.stores),
            "data": (["real", "weights", "fusions", "hubs", "zoom", "agreement", "matchers"], arguments.data),
            "peer": (["lightglue"], arguments.peer),
        }
        options = {name: value for name, (_, value) in own.items() if value}
        for name in options:
            if arguments.what not in own[name][0]:
                parser.error(f"--{name} is for {', '.join(own[name][0])} alone")
        benchmark = import_module(f"experiments.benchmark.{arguments.what}")
        benchmark.run(arguments.rounds, arguments.out or Path(f"runs/benchmark_{arguments.what}.json"), **options)


def positive(text: str) -> int:
    """A whole number above 0, of an option."""
    if not text.isascii() or not text.isdigit() or not int(text[:9]) > 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text}")
    return int(text[:9])


if __name__ == "__main__":
    main()
