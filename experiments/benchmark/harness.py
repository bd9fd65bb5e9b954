"""A contest: everyone is timed in turns, and one table says how many times as long as mfvpr each takes."""

import json
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.console import bar
from mfvpr.report import Table
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

Entry = tuple[str, str, Callable[[], Any]]  # step, who, what is timed
Seconds = Mapping[tuple[str, str], list[float]]  # of every call, by (step, who)
Results = Mapping[tuple[str, str], Any]

QUICK = 0.05  # seconds


@dataclass(frozen=True)
class Lineup:
    """Those who are timed together; each step has a contestant "mfvpr"."""

    title: str
    setting: dict[str, Any]  # for the JSON file
    entries: list[Entry]
    rounds: int  # unless asked for others
    remarks: Callable[[Seconds, Results], Iterable[str]]  # what the table does not say


def compete(lineup: Lineup, rounds: int | None, out: Path) -> None:
    """Print the table and write it as JSON to `out`; `rounds` None = the lineup's own."""
    report(lineup, *take_turns([run for _, _, run in lineup.entries], rounds or lineup.rounds), out)


def take_turns(runs: list[Callable[[], Any]], rounds: int) -> tuple[list[list[float]], list[Any]]:
    """Seconds of every call, after one that compiles and warms up; and what that one returned.

    A contestant of a few milliseconds first gets untimed calls in each of its turns: others have just emptied the
    caches, and their idle threads may still be spinning.
    """
    results = [run() for run in bar("warm-up", len(runs), runs)]
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in bar("rounds", rounds, range(rounds)):
        for run, taken in zip(runs, seconds, strict=True):
            quick = bool(taken) and taken[-1] < QUICK
            for _ in range(10 if quick else 0):
                run()
            start = time.perf_counter()
            run()
            taken.append(time.perf_counter() - start)
    return seconds, results


def report(lineup: Lineup, seconds: list[list[float]], results: list[Any], out: Path) -> None:
    """One table: medians, quartiles, and multiples of mfvpr's time; steps as they are lined up, the fastest first."""
    names = [(step, who) for step, who, _ in lineup.entries]
    rows = []
    for (step, who), taken in zip(names, seconds, strict=True):
        low, middle, high = (1e3 * float(q) for q in np.quantile(taken, (0.25, 0.5, 0.75)))
        rows.append({"step": step, "name": who, "median_ms": middle, "quartiles_ms": [low, high]})
    ours = {row["step"]: row["median_ms"] for row in rows if row["name"] == "mfvpr"}
    rows.sort(key=lambda row: (list(ours).index(row["step"]), row["median_ms"]))
    lines = [
        [row["step"], row["name"], f"{row['median_ms']:.2f}", "{:.2f} .. {:.2f}".format(*row["quartiles_ms"]),
         f"{row['median_ms'] / ours[row['step']]:.2f}"]
        for row in rows
    ]  # fmt: skip
    table = Table(["step", "who", "median, ms", "quartiles, ms", "/ mfvpr"], lines, text_columns=2)
    remarks = list(lineup.remarks(dict(zip(names, seconds, strict=True)), dict(zip(names, results, strict=True))))
    machine = {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "processor": platform.machine()}
    setting = lineup.setting | {"machine": machine, "versions": versions(), "rounds": len(seconds[0])}
    write_text(out, json.dumps(setting | {"remarks": remarks, "results": rows}, indent=1) + "\n")
    print(f"\n{lineup.title}; {machine}\n", table.text(), *remarks, f"results: {out}", sep="\n")
