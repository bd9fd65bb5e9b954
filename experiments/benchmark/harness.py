"""Turns for implementations that are timed together, and the one format of every benchmark's report."""

import json
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.cli.console import progress
from mfvpr.report import Table
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import versions
from mfvpr.utils.numerics import available_cpus

Entry = tuple[str, str, Callable[[], Any]]  # step, implementation, the call that is timed
Seconds = Mapping[tuple[str, str], list[float]]  # (step, implementation) -> seconds of every call
Results = Mapping[tuple[str, str], Any]  # (step, implementation) -> result of the first call

QUICK = 0.05  # seconds


def compete(
    entries: list[Entry], rounds: int, out: Path, *,
    title: str, setting: Mapping[str, Any], remarks: Callable[[Seconds, Results], Iterable[str]],
) -> Results:  # fmt: skip
    """Time entries in turns, print a table below the title, and write it with the setting as JSON to `out`.

    Each step has an implementation called "mfvpr"; the table shows how many times as long the others take.
    """
    seconds, results = take_turns(entries, rounds)
    steps, medians = [step for step, _ in seconds], {name: float(np.median(times)) for name, times in seconds.items()}
    rows, lines = [], []
    for step, name in sorted(seconds, key=lambda entry: (steps.index(entry[0]), medians[entry])):
        median, ratio = 1e3 * medians[step, name], medians[step, name] / medians[step, "mfvpr"]
        low, high = (1e3 * float(np.quantile(seconds[step, name], share)) for share in (0.25, 0.75))
        rows.append({"step": step, "name": name, "median_ms": median, "quartiles_ms": [low, high]})
        lines.append([step, name, f"{median:.2f}", f"{low:.2f} .. {high:.2f}", f"{ratio:.2f}"])
    table = Table(["step", "who", "median, ms", "quartiles, ms", "/ mfvpr"], lines, text_columns=2)
    parts = [table, *remarks(seconds, results)]
    write_report(out, title, parts, {**setting, "rounds": rounds, "results": rows})
    return results


def take_turns(entries: list[Entry], rounds: int) -> tuple[Seconds, Results]:
    """Seconds of every call after an untimed first one, and the results of the first ones.

    Calls of a few milliseconds are repeated untimed before each timed one: other implementations have just emptied the
    caches, and their idle threads may still be spinning.
    """
    results = {(step, name): call() for step, name, call in progress("warm-up", len(entries), entries)}
    seconds: dict[tuple[str, str], list[float]] = {name: [] for name in results}
    for _ in progress("rounds", rounds, range(rounds)):
        for step, name, call in entries:
            times = seconds[step, name]
            is_quick = bool(times) and times[-1] < QUICK
            for _ in range(10 if is_quick else 0):
                call()
            times.append(duration(call))
    return seconds, results


def duration(call: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def ready(function: Callable[..., Any], *inputs: Any, **options: Any) -> Callable[[], Any]:
    """Call of JAX that waits for its result."""
    return lambda: jax.block_until_ready(function(*inputs, **options))


def write_report(out: Path, title: str, parts: Iterable[Table | str], content: Mapping[str, Any]) -> None:
    """Print tables and remarks below a title, and write the remarks and `content` as JSON to `out`."""
    parts = list(parts)
    machine = {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "processor": platform.machine()}
    remarks = [part for part in parts if isinstance(part, str)]
    common = {"machine": machine, "versions": versions(), "remarks": remarks}
    write_text(out, json.dumps(common | dict(content), indent=1) + "\n")
    texts = (part if isinstance(part, str) else part.text() for part in parts)
    print(f"\n{title}; {machine}\n", *texts, f"results: {out}", sep="\n", flush=True)
