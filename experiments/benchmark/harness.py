"""Turns for implementations that are timed together, and the one format of every benchmark's report."""

import json
import platform
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
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
Results = Mapping[tuple[str, str], Any]  # (step, implementation) -> result of the first call

QUICK, REPEATED = 0.05, 10  # seconds; untimed calls at most


def compete(
    entries: Sequence[Entry],
    rounds: int,
    out: Path,
    *,
    title: str,
    remarks: Callable[[Results], Iterable[str]] | None = None,
) -> Results:
    """Time entries, print a table below the title, and write it as JSON to `out`."""
    rows, table, results = measure(entries, rounds)
    write_report(out, title, [table, *(remarks(results) if remarks else [])], {"rounds": rounds, "results": rows})
    return results


def measure(entries: Sequence[Entry], rounds: int) -> tuple[list[dict[str, Any]], Table, Results]:
    """Time entries in turns after a first call, which compiles; the table compares with each step's first entry.

    Calls of a few milliseconds are repeated untimed before each timed one: other implementations have just emptied the
    caches, and their idle threads may still be spinning.
    """
    results, first_calls, seconds = {}, {}, {(step, name): list[float]() for step, name, _ in entries}
    for step, name, call in progress("warm-up", entries):
        start = time.perf_counter()
        results[step, name] = call()
        first_calls[step, name] = time.perf_counter() - start
    for _ in progress("rounds", range(rounds)):
        for step, name, call in entries:
            times = seconds[step, name]
            for _ in range(min(REPEATED, int(QUICK / times[-1])) if times else 0):
                call()
            times.append(duration(call))
    steps, medians = [step for step, _ in seconds], {entry: float(np.median(times)) for entry, times in seconds.items()}
    rows, lines = [], []
    for step, name in sorted(seconds, key=lambda entry: (steps.index(entry[0]), medians[entry])):
        low, median, high = (1e3 * float(np.quantile(seconds[step, name], share)) for share in (0.25, 0.5, 0.75))
        reference = next(entry for entry in seconds if entry[0] == step)
        ratio, first = medians[step, name] / medians[reference], first_calls[step, name]
        rows.append(
            {"step": step, "name": name, "median_ms": median, "quartiles_ms": [low, high], "first_call_s": first}
        )
        lines.append([step, name, f"{median:.2f}", f"{low:.2f} .. {high:.2f}", f"{ratio:.2f}", f"{first:.1f}"])
    header = ["step", "implementation", "median, ms", "quartiles, ms", "/ mfvpr", "first call, s"]
    return rows, Table(header, lines, text_columns=2), results


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
