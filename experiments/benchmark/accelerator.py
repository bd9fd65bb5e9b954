"""Is mfvpr correct and fast on an accelerator? Beside torch on the same device, and beside the device's own rates.

On a CPU all sizes are tiny, which tests the program only.
"""

from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark import networks, scores
from experiments.benchmark.accelerator_checks import check_all
from experiments.benchmark.harness import Entry, measure, ready, write_report
from mfvpr.report import Table
from mfvpr.utils.errors import InputError

AXES = {"sigma": np.linspace(8, 40, 25), "bin_size": np.array([10.0, 15.0]), "weight": ("fs", "unit"),
        "max_distance": np.linspace(0.5, 1.4, 10)}  # fmt: skip
ROUNDS = 10


def product_entries(side: int) -> list[Entry]:
    """Product of square matrices."""
    left, step = jax.random.normal(jax.random.key(3), (side, side)), f"product {side} x {side}"
    product = jax.jit(partial(jnp.matmul, precision=scores.EXACT))
    return [(step, "JAX", ready(product, left, left)), *scores.with_torch(step, "product", left, left)]


def settings_entries(pairs: int) -> list[Entry]:
    """1,000 settings of the histogram."""
    return scores.grid_entries(f"1,000 settings, {pairs:,} pairs", scores.matches_of(pairs), AXES)


def network_entries(batches: tuple[int, ...]) -> list[Entry]:
    """Networks, from images on the host to features on the host; a dense map stays on the device."""
    steps = networks.MAP, networks.FEATURES, f"{networks.ALIKED[0]} features", "MixVPR descriptor"
    contests, images = [each for each in networks.contests() if each.step in steps], networks.make_images(scores.SIZE)
    return [entry for contest in contests for entry in networks.contest_entries(contest, images, batches)]


# Group -> function that returns the entries of one size, sizes on an accelerator, and on a CPU.
GROUPS: dict[str, tuple[Callable[..., list[Entry]], list[tuple[Any, ...]], list[tuple[Any, ...]]]] = {
    "rates": (product_entries, [(8192,)], [(256,)]),
    "matching": (scores.matching_entries, [(50, 700, 512), (1000, 1000, 128)], [(3, 64, 32)]),
    "scores": (scores.scoring_entries, [(50,), (1000,), (10_000,)], [(4,)]),
    "grids": (settings_entries, [(5000,)], [(2,)]),
    "search": (scores.search_entries, [(1_000_000, 512, (1, 100, 1000))], [(2000, 16, (3,))]),
    "networks": (network_entries, [((1, 8),)], [((1,),)]),
    "queries": (scores.ranking_entries, [(1, 50, 700, 512), (1000, 50, 700, 512)], [(1, 3, 64, 32), (3, 3, 64, 32)]),
}
CORRECT = "correct"


def run(rounds: int | None, out: Path, groups: Sequence[str] = ()) -> dict[str, Any]:
    """Run groups, by default all; print a table after each group, and write all tables so far as JSON to `out`."""
    if unknown := {*groups} - {CORRECT, *GROUPS}:
        expected = ", ".join([CORRECT, *GROUPS])
        raise InputError(f"groups: expected some of {expected}, got {', '.join(sorted(unknown))}")
    on_cpu, report = jax.default_backend() == "cpu", {}
    content = {"torch": version("torch") if find_spec("torch") else None, "groups": report}
    for group in groups or [CORRECT, *GROUPS]:
        if group == CORRECT:
            report[group] = check_all(is_small=on_cpu)
            lines = [[f"{cell:.2g}" if isinstance(cell, float) else str(cell) for cell in row.values()]
                     for row in report[group]]  # fmt: skip
            table = Table([*report[group][0]], lines, text_columns=1)
        else:
            function, sizes, small = GROUPS[group]
            entries = [entry for each in (small if on_cpu else sizes) for entry in function(*each)]
            report[group], table, _ = measure(entries, rounds or ROUNDS)
        write_report(out, group, [table], content)
    return report
