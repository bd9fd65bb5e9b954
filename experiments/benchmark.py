"""Times mfvpr against the peers of the field, in one run.

`scores` are matching and scoring of one query with 50 candidates, `sweeps` grids of a score's parameters on cached
matches, `networks` are D2-Net, MixVPR and ALIKED. Everything is warm; the contestants take turns, round by round, so
that a noisy machine disturbs all alike.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.errors import one_line
from experiments.launch import version

if TYPE_CHECKING:
    from experiments.contestants import Lineup

QUICK = 0.05  # seconds


def main() -> None:
    """Print the table and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what", nargs="?", choices=("scores", "sweeps", "networks"), default="scores", help="default: scores"
    )
    parser.add_argument(
        "--rounds", type=positive, help="timed calls of each contestant (default 15; of sweeps 7, of networks 5)"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write (default runs/benchmark_WHAT.json)")
    parser.add_argument("--version", action="version", version=version(), help="print it and exit")
    arguments = parser.parse_args()
    with one_line():
        compete(arguments.what, arguments.rounds, arguments.out or Path(f"runs/benchmark_{arguments.what}.json"))


def compete(what: str, rounds: int | None, out: Path) -> None:
    """Everyone in turns.

    Args:
        what: which benchmark.
        rounds: None = the benchmark's own.
        out: JSON file to write.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # leaves torch its part of a GPU
    if what == "scores":  # here, so that --help need not wait for JAX
        from experiments.contestants import lineup
    elif what == "sweeps":
        from experiments.sweep_contestants import lineup
    else:
        from experiments.network_contestants import lineup

    contest = lineup()
    seconds, results = take_turns([run for _, _, run in contest.entries], rounds or contest.rounds)
    report(contest, seconds, results, out)


def positive(text: str) -> int:
    """A whole number above 0, of an option."""
    if not text.isascii() or not text.isdigit() or not int(text[:9]) > 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text}")
    return int(text[:9])


def take_turns(runs: list[Callable[[], Any]], rounds: int) -> tuple[list[list[float]], list[Any]]:
    """Seconds of every call, after one that compiles and warms up; and what that one returned.

    A contestant of a few milliseconds first gets untimed calls in each of its turns: others have just emptied the
    caches, and their idle threads may still be spinning.
    """
    from tqdm import tqdm

    results = [run() for run in tqdm(runs, desc="warm-up", unit="")]
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in tqdm(range(rounds), desc="rounds", unit=""):
        for run, taken in zip(runs, seconds, strict=True):
            quick = bool(taken) and taken[-1] < QUICK
            for _ in range(10 if quick else 0):
                run()
            start = time.perf_counter()
            run()
            taken.append(time.perf_counter() - start)
    return seconds, results


def report(contest: "Lineup", seconds: list[list[float]], results: list[Any], out: Path) -> None:
    """One table: medians, quartiles, and how many times as long as mfvpr each contestant takes."""
    import jax
    import numpy as np

    from mfvpr.data.files import write_text
    from mfvpr.numerics import available_cpus
    from mfvpr.report.runs import versions
    from mfvpr.report.tables import Table

    names = [(step, name) for step, name, _ in contest.entries]
    found = []
    for (step, name), taken in zip(names, seconds, strict=True):
        low, middle, high = (1e3 * float(q) for q in np.quantile(taken, (0.25, 0.5, 0.75)))
        found.append({"step": step, "name": name, "median_ms": middle, "quartiles_ms": [low, high]})
    ours = {entry["step"]: entry["median_ms"] for entry in found if entry["name"] == "mfvpr"}
    found.sort(key=lambda entry: (list(ours).index(entry["step"]), entry["median_ms"]))
    lines = [
        [entry["step"], entry["name"], f"{entry['median_ms']:.2f}", "{:.2f} .. {:.2f}".format(*entry["quartiles_ms"]),
         f"{entry['median_ms'] / ours[entry['step']]:.2f}"]
        for entry in found
    ]  # fmt: skip
    table = Table(["step", "who", "median, ms", "quartiles, ms", "/ mfvpr"], lines, text_columns=2)
    remarks = list(contest.remarks(dict(zip(names, seconds, strict=True)), dict(zip(names, results, strict=True))))
    machine = {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "processor": platform.machine()}
    setting = contest.setting | {"machine": machine, "versions": versions(), "rounds": len(seconds[0])}
    write_text(out, json.dumps(setting | {"remarks": remarks, "results": found}, indent=1) + "\n")
    print(f"\n{contest.title}; {machine}\n", table.text(), *remarks, f"results: {out}", sep="\n")


if __name__ == "__main__":
    main()
