"""Grids of the scores' parameters in mfvpr, and in NumPy on one process and on several."""

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Results, Seconds, compete
from experiments.benchmark.scores import CANDIDATES, SIZE, make_data
from mfvpr.core.types import Matches
from mfvpr.core.weights import match_weights
from mfvpr.utils.numerics import available_cpus

SIGMAS, BIN_SIZES = (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), (5.0, 10.0, 15.0, 20.0)  # px
WEIGHTS = (mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight(), mfvpr.UnitWeight())
DISTANCE_SHARES = (0.25, 0.5, 0.75, 1.0)  # shares of the matches that are nearer than the four distances
WINDOWS, TOLERANCES = (4.0, 6.0, 8.0, 10.0, 12.0), (1.0, 2.0, 3.0, 4.0, 5.0)  # cells
SLOTS = 256
HISTOGRAM, WEIGHTED, ANCHOR = "6 x 4 histograms", "6 x 4 x 3 weights x 4 distances", "5 x 5 anchors"

Team = Callable[[np.ndarray, np.ndarray], np.ndarray]  # `tallest_bins` in some processes


def run(rounds: int | None, out: Path) -> None:
    """Time all grids on the same pairs."""
    teams = {f"NumPy, {count} process{'es' * (count > 1)}": make_team(count) for count in sorted({1, available_cpus()})}
    same = _full_matches()
    flushed = "flushed for all" if flush_denormals() else "flushed for mfvpr only (NumPy needs torch for it)"
    entries = [
        *_histogram_entries("same place", same, teams),  # nearly all matches agree
        *_histogram_entries("other place", _shuffle(same), teams),  # none agree
        *_anchor_entries(same),
    ]
    setting = {"pairs": CANDIDATES, "matches_per_pair": SLOTS, "sigma": SIGMAS, "bin_size": BIN_SIZES,
               "denormals": flushed}  # fmt: skip
    title = f"{CANDIDATES} pairs with {SLOTS} matches each; denormal floats {flushed}"
    compete(entries, rounds or 7, out, title=title, setting=setting, remarks=_remarks)


def _remarks(seconds: Seconds, results: Results) -> Iterable[str]:
    for (step, name), taken in seconds.items():
        ours = np.asarray(results[step, "mfvpr"])
        rate = f"{step}, {name}: {ours.size / np.median(taken):,.0f} pair-scores per second"
        theirs = np.asarray(results[step, name]).reshape(ours.shape)
        yield rate if name == "mfvpr" else f"{rate}, scores differ by {np.max(abs(theirs / ours - 1)):.1e} at most"


def _full_matches() -> Matches:
    """The first matches of the pairs of `scores`, which fill all slots."""
    matches = jax.vmap(lambda pair: mfvpr.compact(pair, SLOTS))(make_data().matches)
    return jax.device_put(replace(matches, mask=jnp.ones_like(matches.mask)))


def _shuffle(matches: Matches) -> Matches:
    """Points that do not correspond, as in images of different places, which most pairs of a sweep show."""
    order = np.random.default_rng(0).permuted(np.tile(np.arange(SLOTS), (CANDIDATES, 1)), axis=1)
    return replace(matches, points1=jnp.take_along_axis(matches.points1, order[..., None], axis=1))


def _histogram_entries(place: str, matches: Matches, teams: dict[str, Team]) -> list[Entry]:
    distances = np.quantile(np.asarray(matches.distance), DISTANCE_SHARES).astype(np.float32)
    near = (np.asarray(matches.distance)[:, None] <= distances[:, None]).astype(np.float32)  # [C, 4, K]
    weights = [np.asarray(jax.vmap(partial(match_weights, weight))(matches)) for weight in WEIGHTS]
    near_weights = np.concatenate([weight[:, None] * near for weight in weights], axis=1)
    shifts = np.asarray(matches.points1 - matches.points0)
    entries = []
    for name, axes, team_weights in (
        (HISTOGRAM, {}, weights[0][:, None]),
        (WEIGHTED, {"weight": WEIGHTS, "max_distance": distances}, near_weights),
    ):
        step, axes = f"{name}, {place}", {"sigma": SIGMAS, "bin_size": BIN_SIZES} | axes
        entries.append((step, "mfvpr", _grid_call(mfvpr.HistogramOfShifts(), matches, **axes)))
        entries += [(step, title, partial(team, shifts, team_weights)) for title, team in teams.items()]
    return entries


def _anchor_entries(matches: Matches) -> list[Entry]:
    axes = {"window": WINDOWS, "tolerance": TOLERANCES}
    return [
        (f"{ANCHOR}, {cells} cells a side", "mfvpr", _grid_call(mfvpr.AnchorPoints(num_bins=cells), matches, **axes))
        for cells in (10, 15, 20)
    ]


def _grid_call(scorer: Any, matches: Matches, **axes: Any) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(mfvpr.score_grid(scorer, matches, **axes))


def make_team(count: int) -> Team:
    """Run `tallest_bins` in `count` processes of one thread each, every process on its share of the pairs."""
    # BLAS reads these variables when it is loaded: in the new processes, no longer in this one.
    os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=flush_denormals)

    def team(shifts: np.ndarray, weights: np.ndarray) -> np.ndarray:
        parts = pool.map(tallest_bins, np.array_split(shifts, count), np.array_split(weights, count))
        return np.concatenate(list(parts), axis=-1)

    return team


def flush_denormals() -> bool:
    """Count denormal floats of this thread as zero, as XLA does; False without torch, since NumPy has no switch."""
    if find_spec("torch") is None:
        return False
    import torch

    return torch.set_flush_denormal(True)


def tallest_bins(shifts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Scores `[sigmas, bin sizes, W, C]` as users of NumPy would write it, one pair and setting after the other.

    The Gaussians are separable, and the same for all weights, which are one matrix product.

    Args:
        shifts: `[C, K, 2]` px.
        weights: `[C, W, K]`.
    """
    num_pairs, num_weights, slots = weights.shape
    tallest = np.empty((len(SIGMAS), len(BIN_SIZES), num_weights, num_pairs), np.float32)
    for j, size in enumerate(BIN_SIZES):
        centers = np.arange(-SIZE + size / 2, SIZE + size / 2, size, dtype=np.float32)
        x, y = (np.square(centers[:, None] - shifts[:, None, :, axis]) for axis in (0, 1))  # [C, B, K]
        for i, sigma in enumerate(SIGMAS):
            scale = np.float32(-0.5 / sigma**2)
            for pair in range(num_pairs):
                votes_x, votes_y = np.exp(x[pair] * scale), np.exp(y[pair] * scale)
                weighted = (weights[pair][:, None] * votes_y[None]).reshape(-1, slots)
                tallest[i, j, :, pair] = (weighted @ votes_x.T).reshape(num_weights, -1).max(1)
    return tallest
