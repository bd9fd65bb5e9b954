"""Who takes part in the benchmark of sweeps: grids of the scores' parameters, mfvpr's and NumPy's."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments import contestants
from experiments.contestants import CANDIDATES, SIZE, Entry, Lineup
from experiments.numpy_sweeps import Workers, flush_denormals
from mfvpr.numerics import available_cpus
from mfvpr.types import Matches
from mfvpr.weighting import match_weights

SIGMAS, BIN_SIZES = (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), (5.0, 10.0, 15.0, 20.0)  # px
WEIGHTS = (mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight(), mfvpr.UnitWeight())
DISTANCE_SHARES = (0.25, 0.5, 0.75, 1.0)  # of the matches are nearer than the four distances
WINDOWS, TOLERANCES = (4.0, 6.0, 8.0, 10.0, 12.0), (1.0, 2.0, 3.0, 4.0, 5.0)  # cells
SLOTS = 256
HISTOGRAM, WEIGHTED, ANCHOR = "6 x 4 histograms", "6 x 4 x 3 weights x 4 distances", "5 x 5 anchors"
SAME, OTHER = "same place", "other place"  # nearly all matches agree, none do


def lineup() -> Lineup:
    """Everyone, on the same pairs."""
    counts = sorted({1, available_cpus()})
    teams = {f"NumPy, {count} process{'es' * (count > 1)}": Workers(count) for count in counts}
    same = _matches()
    places = {SAME: same, OTHER: _shuffled(same)}
    flushed = "flushed for all" if flush_denormals() else "flushed for mfvpr only (NumPy needs torch for it)"
    return Lineup(
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


def _remarks(seconds: Mapping[tuple[str, str], list[float]], results: Mapping[tuple[str, str], Any]) -> Iterable[str]:
    for (step, name), taken in seconds.items():
        ours = np.asarray(results[step, "mfvpr"])
        rate = f"{step}, {name}: {ours.size / np.median(taken):,.0f} pair-scores per second"
        theirs = np.asarray(results[step, name]).reshape(ours.shape)
        yield rate if name == "mfvpr" else f"{rate}, scores differ by {np.max(abs(theirs / ours - 1)):.1e} at most"


def _matches() -> Matches:
    """All slots full: the first real matches of the pairs of the other benchmark."""
    data = contestants.make_data()
    matches = jax.vmap(lambda pair: mfvpr.compact(pair, SLOTS))(data.matches)
    return jax.device_put(replace(matches, mask=jnp.ones_like(matches.mask)))


def _shuffled(matches: Matches) -> Matches:
    """As between images of different places, which is what most pairs of a sweep are: points that do not correspond."""
    order = np.random.default_rng(0).permuted(np.tile(np.arange(SLOTS), (CANDIDATES, 1)), axis=1)
    return replace(matches, points1=jnp.take_along_axis(matches.points1, order[..., None], axis=1))


def _histograms(place: str, matches: Matches, teams: Mapping[str, Workers]) -> list[Entry]:
    distances = np.quantile(np.asarray(matches.distance), DISTANCE_SHARES).astype(np.float32)
    shared = {"sigma": SIGMAS, "bin_size": BIN_SIZES}
    steps = {HISTOGRAM: shared, WEIGHTED: shared | {"weight": WEIGHTS, "max_distance": distances}}
    near = (np.asarray(matches.distance)[:, None] <= distances[:, None]).astype(np.float32)  # [C, 4, K]
    kinds = [np.asarray(jax.vmap(partial(match_weights, weight))(matches)) for weight in WEIGHTS]
    every = np.concatenate([kind[:, None] * near for kind in kinds], axis=1)
    weights = {HISTOGRAM: kinds[0][:, None], WEIGHTED: every}
    shifts = np.asarray(matches.points1 - matches.points0)

    def numpy_grid(team: Workers, weights: np.ndarray) -> Callable[[], Any]:
        return lambda: team(shifts, weights, SIGMAS, BIN_SIZES, SIZE)

    found = []
    for step, axes in steps.items():
        found.append((f"{step}, {place}", "mfvpr", _grid(mfvpr.HistogramOfShifts(), matches, **axes)))
        found += [(f"{step}, {place}", name, numpy_grid(team, weights[step])) for name, team in teams.items()]
    return found


def _anchors(matches: Matches) -> list[Entry]:
    axes = {"window": WINDOWS, "tolerance": TOLERANCES}
    return [
        (f"{ANCHOR}, {cells} cells a side", "mfvpr", _grid(mfvpr.AnchorPoints(num_bins=cells), matches, **axes))
        for cells in (10, 15, 20)
    ]


def _grid(scorer: Any, matches: Matches, **axes: Any) -> Callable[[], Any]:
    return lambda: jax.block_until_ready(mfvpr.score_grid(scorer, matches, **axes))
