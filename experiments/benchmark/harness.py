"""Turns for implementations that are timed together, and the one format of every benchmark's report."""

import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mfvpr.checkpoints import REGISTRY, is_installed
from mfvpr.cli.console import progress
from mfvpr.report import Table
from mfvpr.utils.files import write_text
from mfvpr.utils.fingerprints import versions
from mfvpr.utils.numerics import available_cpus

Entry = tuple[str, str, Callable[[], Any]]  # step, implementation, the call that is timed
Rows = list[dict[str, Any]]  # of a table, by column

QUICK, REPEATED = 0.05, 10  # seconds; untimed calls at most


def measure(entries: Sequence[Entry], rounds: int) -> Rows:
    """Time entries in turns after a first call, which compiles; each step is compared with its first entry.

    Calls of a few milliseconds are repeated untimed before each timed one: other implementations have just emptied the
    caches, and their idle threads may still be spinning.
    """
    first = {(step, name): duration(call) for step, name, call in progress("warm-up", entries)}
    seconds = {entry: list[float]() for entry in first}
    for _ in progress("rounds", range(rounds)):
        for step, name, call in entries:
            times = seconds[step, name]
            for _ in range(min(REPEATED, int(QUICK / times[-1])) if times else 0):
                call()
            times.append(duration(call))
    rows, medians = [], {entry: float(np.median(times)) for entry, times in seconds.items()}
    for step in dict.fromkeys(step for step, _ in seconds):
        names = [name for entry_step, name in seconds if entry_step == step]
        for name in sorted(names, key=lambda name: medians[step, name]):
            low, median, high = (1e3 * float(np.quantile(seconds[step, name], share)) for share in (0.25, 0.5, 0.75))
            row = {"step": step, "implementation": name, "median, ms": median, "quartiles, ms": [low, high]}
            ratio = medians[step, name] / medians[step, names[0]]
            rows.append(row | {"/ mfvpr": ratio, "first call, s": first[step, name]})
    return rows


def duration(call: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def ready(function: Callable[..., Any], *inputs: Any, **options: Any) -> Callable[[], Any]:
    """Call of JAX that waits for its result."""
    return lambda: jax.block_until_ready(function(*inputs, **options))


@cache
def torch_or_none() -> Any:
    """Torch, whose products are of float32 without TF32; None if it is missing, or lacks JAX's device."""
    if find_spec("torch") is None:
        return None
    import torch

    torch.set_flush_denormal(True)  # as XLA does; far bins are denormal floats, which make torch four times as slow
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    return torch if jax.default_backend() == "cpu" or torch.cuda.is_available() else None


def ready_torch(function: Callable[..., Any], *inputs: Any, **options: Any) -> Callable[[], Any]:
    """Call of torch that waits for its result."""
    torch = torch_or_none()

    def call() -> Any:
        with torch.inference_mode():
            result = function(*inputs, **options)
        if jax.default_backend() != "cpu":
            torch.cuda.synchronize()
        return result

    return call


def write_report(out: Path, groups: Mapping[str, Rows]) -> None:
    """Print the last of the groups, and write all as JSON to `out`."""
    machine = {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "processor": platform.machine()}
    torch = torch_or_none()
    about = versions() | ({"torch": torch.__version__} if torch else {})
    weights = [name for name, entry in REGISTRY.items() if is_installed(entry)]  # others are random
    content = {"machine": machine, "versions": about, "published weights": weights, "groups": dict(groups)}
    write_text(out, json.dumps(content, indent=1) + "\n")
    title, rows = [*groups.items()][-1]
    lines = [[*map(_cell, row.values())] for row in rows]
    print(f"\n{title}; {machine}; published weights: {', '.join(weights) or 'none'}\n")
    print(Table([*rows[0]], lines, text_columns=2), f"results: {out}", sep="\n", flush=True)


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return " .. ".join(map(_cell, value))
    if isinstance(value, float):
        return f"{value:.2f}" if value >= 0.1 else f"{value:.2g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
