"""Times mfvpr against other implementations of the same computation.

All implementations of a step run in turns after a warm-up, so that other load on the machine slows them all alike.
"""

import argparse
import os
from importlib import import_module
from pathlib import Path

from mfvpr.cli.programs import Parser, run_command
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT
from mfvpr.utils.files import require_replaceable

PROGRAM = "python -m experiments.benchmark"
# Name -> what it measures. Its function `(rounds, out)` prints tables and writes them as JSON to `out`.
BENCHMARKS = {
    "scores": "matching and scoring of one query with 50 candidates (15 rounds)",
    "search": "nearest global descriptors of 1, 20 and 100 queries among 10,000 and 100,000 (5 rounds; 6 GB)",
    "sweeps": "grids of a score's parameters on cached matches (7 rounds)",
    "networks": "D2-Net, MixVPR, ALIKED beside torch; NetVLAD, Patch-NetVLAD, ResNet-50, SelaVPR (5 rounds; 30 min)",
    "accelerator": "correct and fast on a GPU? All steps beside torch there (10 rounds)",
    "localize": "maps of 1,000 and 10,000 images: time from image file to prediction (3 rounds)",
}
_FUNCTIONS = {"search": ("scores", "run_search"), "sweeps": ("scores", "run_sweeps")}  # the others: NAME.run


def main() -> None:
    """Run the chosen benchmark."""
    run_command(PROGRAM, str(__doc__), add_arguments)


def add_arguments(parser: Parser) -> None:
    """Declare the command line. The benchmark's module is imported later, so that --help does not wait for JAX."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(["benchmarks:", *(f"  {name:<12} {about}" for name, about in BENCHMARKS.items())])
    parser.add_argument("benchmark", nargs="?", choices=BENCHMARKS, default="scores", help="default: scores")
    parser.add_argument("groups", nargs="*", help="accelerator: groups of steps, in this order (default: all)")
    parser.add_argument("--rounds", type=int, help="timed calls of each implementation (default: see below)")
    parser.add_argument("--out", type=Path, help="JSON file to write (default: runs/benchmark_BENCHMARK.json)")
    parser.set_defaults(run="experiments.benchmark.__main__:run")


def run(benchmark: str, groups: list[str], rounds: int | None, out: Path | None) -> None:
    """Run a benchmark."""
    (COUNT | None).check("--rounds", rounds)
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # leaves torch its part of a GPU
    module, function = _FUNCTIONS.get(benchmark, (benchmark, "run"))
    run_benchmark = getattr(import_module(f"experiments.benchmark.{module}"), function)
    out = out or Path(f"runs/benchmark_{benchmark}.json")
    require_replaceable(out, b'{\n "machine": {')
    if benchmark == "accelerator":
        run_benchmark(rounds, out, groups)
    elif groups:
        raise InputError(f"groups: expected none for {benchmark}, got {' '.join(groups)}; they belong to accelerator")
    else:
        run_benchmark(rounds, out)


if __name__ == "__main__":
    main()
