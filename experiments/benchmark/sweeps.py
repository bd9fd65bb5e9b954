"""Grids of the scores' parameters: mfvpr's, and NumPy's in processes of its own."""

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
from experiments.benchmark import scores
from experiments.benchmark.harness import Entry, Lineup, Results, Seconds, compete
from experiments.benchmark.scores import CANDIDATES, SIZE
from mfvpr.scoring.weights import match_weights
from mfvpr.types import Matches
from mfvpr.utils.numerics import available_cpus

SIGMAS, BIN_SIZES = (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), (5.0, 10.0, 15.0, 20.0)  # px
WEIGHTS = (mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight(), mfvpr.UnitWeight())
DISTANCE_SHARES = (0.25, 0.5, 0.75, 1.0)  # of the matches are nearer than the four distances
WINDOWS, TOLERANCES = (4.0, 6.0, 8.0, 10.0, 12.0), (1.0, 2.0, 3.0, 4.0, 5.0)  # cells
SLOTS = 256
HISTOGRAM, WEIGHTED, ANCHOR = "6 x 4 histograms", "6 x 4 x 3 weights x 4 distances", "5 x 5 anchors"

Team = Callable[[np.ndarray, np.ndarray], np.ndarray]  # does what `tallest_bins` does


def run(rounds: int | None, out: Path) -> None:
    """Everyone, on the same pairs."""
    teams = {f"NumPy, {count} process{'es' * (count > 1)}": team(count) for count in sorted({1, available_cpus()})}
    same = _matches()
    places = {"same place": same, "other place": _shuffled(same)}  # nearly all matches agree, none do
    flushed = "flushed for all" if flush_denormals() else "flushed for mfvpr only (NumPy needs torch for it)"
    lineup = Lineup(
        title=f"{CANDIDATES} pairs with {SLOTS} matches each; denormal floats {flushed}",
        setting={
            "pairs": CANDIDATES, "matches_per_pair": SLOTS, "sigma": SIGMAS, "bin_size": BIN_SIZES,
            "denormals": flushed,
        },
        entries=[entry for place, pairs in places.items() for entry in _histograms(place, pairs, teams)]
        + _anchors(same),
        rounds=7,
        remarks=_remarks,
    )  # fmt: skip
    compete(lineup, rounds, out)


def _remarks(seconds: Seconds, results: Results) -> Iterable[str]:
    for (step, name), taken in seconds.items():
        ours = np.asarray(results[step, "mfvpr"])
        rate = f"{step}, {name}: {ours.size / np.median(taken):,.0f} pair-scores per second"
        theirs = np.asarray(results[step, name]).reshape(ours.shape)
        yield rate if name == "mfvpr" else f"{rate}, scores differ by {np.max(abs(theirs / ours - 1)):.1e} at most"


def _matches() -> Matches:
    """All slots full: the first real matches of the pairs of `scores`."""
    matches = jax.vmap(lambda pair: mfvpr.compact(pair, SLOTS))(scores.make_data().matches)
    return jax.device_put(replace(matches, mask=jnp.ones_like(matches.mask)))


def _shuffled(matches: Matches) -> Matches:
    """As between images of different places, which is what most pairs of a sweep are: points that do not correspond."""
    order = np.random.default_rng(0).permuted(np.tile(np.arange(SLOTS), (CANDIDATES, 1)), axis=1)
    return replace(matches, points1=jnp.take_along_axis(matches.points1, order[..., None], axis=1))


def _histograms(place: str, matches: Matches, teams: dict[str, Team]) -> list[Entry]:
    distances = np.quantile(np.asarray(matches.distance), DISTANCE_SHARES).astype(np.float32)
    near = (np.asarray(matches.distance)[:, None] <= distances[:, None]).astype(np.float32)  # [C, 4, K]
    kinds = [np.asarray(jax.vmap(partial(match_weights, weight))(matches)) for weight in WEIGHTS]
    every = np.concatenate([kind[:, None] * near for kind in kinds], axis=1)
    shifts = np.asarray(matches.points1 - matches.points0)
    entries = []
    for name, axes, weights in (
        (HISTOGRAM, {}, kinds[0][:, None]),
        (WEIGHTED, {"weight": WEIGHTS, "max_distance": distances}, every),
    ):
        step, axes = f"{name}, {place}", {"sigma": SIGMAS, "bin_size": BIN_SIZES} | axes
        entries.append((step, "mfvpr", _grid(mfvpr.HistogramOfShifts(), matches, **axes)))
        entries += [(step, who, partial(numpy_grid, shifts, weights)) for who, numpy_grid in teams.items()]
    return entries


def _anchors(matches: Matches) -> list[Entry]:
    axes = {"window": WINDOWS, "tolerance": TOLERANCES}
    return [
        (f"{ANCHOR}, {cells} cells a side", "mfvpr", _grid(mfvpr.AnchorPoints(num_bins=cells), matches, **axes))
        for cells in (10, 15, 20)
    ]


def _grid(scorer: Any, matches: Matches, **axes: Any) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(mfvpr.score_grid(scorer, matches, **axes))


def team(count: int) -> Team:
    """`tallest_bins` in `count` processes, each a part of the pairs and a single thread."""
    # Their BLAS reads it when it is loaded, which here was long ago.
    os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=flush_denormals)

    def in_parts(shifts: np.ndarray, weights: np.ndarray) -> np.ndarray:
        parts = pool.map(tallest_bins, np.array_split(shifts, count), np.array_split(weights, count))
        return np.concatenate(list(parts), axis=-1)

    return in_parts


def flush_denormals() -> bool:
    """Whether this thread's denormal floats now count as zero, as in XLA's; NumPy itself has no such switch."""
    if find_spec("torch") is None:
        return False
    import torch

    return torch.set_flush_denormal(True)


def tallest_bins(shifts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Scores `[sigmas, bin sizes, W, C]` as NumPy's users would write it, one pair and setting after the other.

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
