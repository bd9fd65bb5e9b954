"""Who takes part in the benchmark of sweeps: a grid of the histogram's parameters, and what it is made of."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments import contestants
from experiments.contestants import CANDIDATES, SIZE, Entry, Lineup
from mfvpr.types import Matches

SIGMAS, BIN_SIZES = (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), (5.0, 10.0, 15.0, 20.0)  # px
WINDOWS, TOLERANCES = (4.0, 6.0, 8.0, 10.0, 12.0), (1.0, 2.0, 3.0, 4.0, 5.0)  # cells
SLOTS = 256
HISTOGRAM, WEIGHTED, ANCHOR = (
    "histogram, 6 x 4 grid",
    "histogram, 6 x 4 x 3 weights x 4 distances",
    "anchor, 5 x 5 grid",
)
SETTINGS = {HISTOGRAM: 24, WEIGHTED: 24 * 12, ANCHOR: 25}


def lineup() -> Lineup:
    """Everyone, on the same pairs."""
    matches = _matches()
    return Lineup(
        title=f"{CANDIDATES} pairs with {SLOTS} matches each",
        setting={"pairs": CANDIDATES, "matches_per_pair": SLOTS, "sigma": SIGMAS, "bin_size": BIN_SIZES},
        entries=[*_of_mfvpr(matches), *_bare_products(), *_of_numpy(matches)],
        rounds=7,
        remarks=_remarks,
    )


def _remarks(seconds: Mapping[tuple[str, str], list[float]], results: Mapping[tuple[str, str], Any]) -> Iterable[str]:
    for (step, name), taken in seconds.items():
        yield f"{step}, {name}: {CANDIDATES * SETTINGS[step] / np.median(taken):,.0f} pair-scores per second"


def _matches() -> Matches:
    """All slots full: the first real matches of the pairs of the other benchmark."""
    data = contestants.make_data()
    matches = jax.vmap(lambda pair: mfvpr.compact(pair, SLOTS))(data.matches)
    return jax.device_put(replace(matches, mask=jnp.ones_like(matches.mask)))


def _of_mfvpr(matches: Matches) -> list[Entry]:
    weights = [mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight(), mfvpr.UnitWeight()]
    distances = (0.6, 0.9, 1.2, 2.0)

    def grid(scorer: Any, **axes: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(mfvpr.score_grid(scorer, matches, **axes))

    histogram, shared = mfvpr.HistogramOfShifts(), {"sigma": SIGMAS, "bin_size": BIN_SIZES}
    return [
        (HISTOGRAM, "mfvpr", grid(histogram, **shared)),
        (WEIGHTED, "mfvpr", grid(histogram, **shared, weight=weights, max_distance=distances)),
        (ANCHOR, "mfvpr", grid(mfvpr.AnchorPoints(), window=WINDOWS, tolerance=TOLERANCES)),
    ]


def _bare_products() -> list[Entry]:
    """What a histogram cannot do without: the product of its votes along y and x, and its largest entry."""
    rng = np.random.default_rng(0)
    bins = [int(np.ceil(2 * SIZE / size)) for size in BIN_SIZES]
    votes = [jax.device_put(rng.random((2, CANDIDATES, count, SLOTS)).astype(np.float32)) for count in bins]

    @jax.jit
    def one(votes: list[jax.Array]) -> list[jax.Array]:
        exact = jax.lax.Precision.HIGHEST
        return [jnp.max(jnp.matmul(y, x.mT, precision=exact), axis=(1, 2)) for y, x in votes]

    def repeated(times: int) -> Callable[[], Any]:
        return lambda: [jax.block_until_ready(one(votes)) for _ in range(times)]

    return [(HISTOGRAM, "bare product (JAX)", repeated(len(SIGMAS))), (WEIGHTED, "bare product (JAX)", repeated(72))]


def _of_numpy(matches: Matches) -> list[Entry]:
    """Pair by pair and setting by setting, all bins and matches of a pair at once."""
    shifts, weights = np.asarray(matches.points1 - matches.points0), np.asarray(matches.scores0 + matches.scores1)

    def broadcast() -> list[float]:
        found = []
        for size in BIN_SIZES:
            centers = np.arange(-SIZE + size / 2, SIZE + size / 2, size, dtype=np.float32)
            x, y = (np.square(centers[None] - shifts[:, :, axis, None]) for axis in (0, 1))  # [C, K, B]
            for sigma in SIGMAS:
                for of_x, of_y, weight in zip(x, y, weights, strict=True):
                    votes = np.exp((of_x[:, None] + of_y[:, :, None]) * np.float32(-0.5 / sigma**2))
                    found.append(float(np.tensordot(weight, votes, 1).max()))
        return found

    def separable() -> list[float]:
        found = []
        for size in BIN_SIZES:
            centers = np.arange(-SIZE + size / 2, SIZE + size / 2, size, dtype=np.float32)
            x, y = (np.square(centers[:, None] - shifts[:, None, :, axis]) for axis in (0, 1))  # [C, B, K]
            for sigma in SIGMAS:
                scale = np.float32(-0.5 / sigma**2)
                for of_x, of_y, weight in zip(x, y, weights, strict=True):
                    found.append(float((np.exp(of_y * scale) * weight @ np.exp(of_x * scale).T).max()))
        return found

    return [(HISTOGRAM, "NumPy, broadcast", broadcast), (HISTOGRAM, "NumPy, separable", separable)]
