"""Times matching and scoring of one query with 50 candidates against the peers of the field, in one run.

Everything is warm; the contestants take turns, round by round, so that a noisy machine disturbs all alike.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

QUICK = 0.05  # seconds


def main() -> None:
    """Print the table and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15, help="timed calls of each contestant (default 15)")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark.json"), help="JSON file to write")
    arguments = parser.parse_args()

    from experiments import contestants  # here, so that --help need not wait for JAX

    data = contestants.make_data()
    entries = [entry for make in contestants.ALL for entry in make(data)]
    seconds = take_turns([run for _, _, run in entries], arguments.rounds)
    report(entries, seconds, data, arguments)


def take_turns(runs: list[Callable[[], Any]], rounds: int) -> list[list[float]]:
    """Seconds of every call, after one that compiles and warms up.

    A contestant of a few milliseconds first gets untimed calls in each of its turns: others have just emptied the
    caches, and their idle threads may still be spinning.
    """
    from tqdm import tqdm

    for run in tqdm(runs, desc="warm-up", unit=""):
        run()
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in tqdm(range(rounds), desc="rounds", unit=""):
        for run, taken in zip(runs, seconds, strict=True):
            quick = bool(taken) and taken[-1] < QUICK
            for _ in range(10 if quick else 0):
                run()
            start = time.perf_counter()
            run()
            taken.append(time.perf_counter() - start)
    return seconds


def report(entries: list, seconds: list[list[float]], data: Any, arguments: argparse.Namespace) -> None:
    """One table: medians, quartiles, and how many times as long as mfvpr each contestant takes."""
    import jax
    import numpy as np

    from experiments.contestants import CANDIDATES, DIMENSION, KEYPOINTS
    from mfvpr.data.files import write_text
    from mfvpr.report.runs import versions
    from mfvpr.report.tables import Table

    found = []
    for (step, name, _), taken in zip(entries, seconds, strict=True):
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
    setting = {
        "candidates": CANDIDATES, "keypoints": KEYPOINTS, "dimension": DIMENSION,
        "matches_per_pair": float(np.asarray(data.matches.mask).sum(1).mean()),
        "machine": {"device": jax.devices()[0].device_kind, "cores": os.cpu_count(), "processor": platform.machine()},
        "versions": versions(), "rounds": arguments.rounds,
    }  # fmt: skip
    write_text(arguments.out, json.dumps(setting | {"results": found}, indent=1) + "\n")
    print(
        f"\n1 query x {CANDIDATES} candidates, {KEYPOINTS} features of {DIMENSION} dimensions, "
        f"{setting['matches_per_pair']:.0f} matches a pair; {setting['machine']}\n\n{table.text()}\n"
        f"anchor / histogram: {ours['anchor'] / ours['histogram']:.2f}\nresults: {arguments.out}"
    )


if __name__ == "__main__":
    main()
