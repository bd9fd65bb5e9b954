"""Scores, sweeps and search in mfvpr, and in other libraries as their users would write them.

`run` times matching and scoring, `run_search` the exact search of global descriptors (in the memory of each library
beforehand), `run_sweeps` grids of the scores' parameters, in NumPy on one process and on several. Each `*_entries`
function returns the calls to time, none where its library is not installed.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Results, Seconds, compete, ready
from mfvpr.core.types import Features, Matches
from mfvpr.core.weights import match_weights
from mfvpr.utils.numerics import available_cpus

CANDIDATES, KEYPOINTS, DIMENSION = 50, 700, 512
COMMON = 300  # keypoints that a candidate shares with the query
SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
MATCHING, HISTOGRAM, ANCHOR, SUM = "matching", "histogram", "anchor", "sum"
SHIFT = "refined shift of a pair"
BOTH = "matching + histogram"
SLOTS = 384  # of 700; these pairs need no more
CENTERS = np.arange(-SIZE + BIN / 2, SIZE, BIN, dtype=np.float32)
BIN_X, BIN_Y = np.meshgrid(CENTERS, CENTERS)
# Of searches.
SEARCH_SIZES = ((10_000, 512), (10_000, 4096), (100_000, 512), (100_000, 4096))  # rows and dimensions of the database
QUERIES = (1, 20, 100)
# Of sweeps.
SIGMAS, BIN_SIZES = (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), (5.0, 10.0, 15.0, 20.0)  # px
WEIGHTS = (mfvpr.FeatureScoreWeight(), mfvpr.DescriptorDistanceWeight(), mfvpr.UnitWeight())
DISTANCE_SHARES = (0.25, 0.5, 0.75, 1.0)  # shares of the matches that are nearer than the four distances
WINDOWS, TOLERANCES = (4.0, 6.0, 8.0, 10.0, 12.0), (1.0, 2.0, 3.0, 4.0, 5.0)  # cells
SWEEP_SLOTS = 256
GRID, WEIGHTED_GRID, ANCHOR_GRID = "6 x 4 histograms", "6 x 4 x 3 weights x 4 distances", "5 x 5 anchors"

Team = Callable[[np.ndarray, np.ndarray], np.ndarray]  # `tallest_bins` in some processes


@dataclass(frozen=True)
class Data:
    """One query, its candidates, and their matches; descriptors are non-negative like those of D2-Net."""

    query: Features  # [N, ...]
    candidates: Features  # [C, N, ...]
    matches: Matches  # [C, SLOTS, ...]


def run(rounds: int | None, out: Path) -> None:
    """Time all libraries on one query and its candidates."""
    data = make_data()
    matches = float(np.asarray(data.matches.mask).sum(1).mean())
    sizes = f"1 query x {CANDIDATES} candidates, {KEYPOINTS} features of {DIMENSION} dimensions"
    libraries = (mfvpr_entries, opencv_entries, faiss_entries, torch_entries, numpy_entries)
    entries = [entry for entries in libraries for entry in entries(data)]
    setting = {"candidates": CANDIDATES, "keypoints": KEYPOINTS, "dimension": DIMENSION, "matches_per_pair": matches}
    title = f"{sizes}, {matches:.0f} matches a pair"
    compete(entries, rounds or 15, out, title=title, setting=setting, remarks=_remarks)


def _remarks(seconds: Seconds, _: Results) -> list[str]:
    anchor, histogram = (np.median(seconds[step, "mfvpr"]) for step in (ANCHOR, HISTOGRAM))
    return [f"anchor / histogram: {anchor / histogram:.2f}"]


def make_data(seed: int = 0) -> Data:
    """Candidates show COMMON keypoints of the query, shifted and with noise; their other keypoints are random."""
    rng = np.random.default_rng(seed)

    def descriptors(count: int) -> np.ndarray:
        return np.maximum(rng.normal(size=(count, DIMENSION)), 0)

    def features(points: np.ndarray, values: np.ndarray) -> Features:
        values = np.maximum(values, 0)
        values /= np.linalg.norm(values, axis=1, keepdims=True)
        arrays = points, values, rng.uniform(100, 1000, KEYPOINTS), np.ones(KEYPOINTS), np.full(2, SIZE)
        keypoints, values, scores, mask, size = (array.astype(np.float32) for array in arrays)
        return Features(keypoints, values, scores, mask > 0, size)

    points, values = rng.uniform(40, SIZE - 40, (KEYPOINTS, 2)), descriptors(KEYPOINTS)
    candidates = []
    for _ in range(CANDIDATES):
        common = rng.permutation(KEYPOINTS)[:COMMON]
        moved = points[common] + rng.uniform(-30, 30, 2) + rng.normal(0, 5, (COMMON, 2))
        noisy = values[common] + 0.3 * rng.normal(size=(COMMON, DIMENSION))
        order = rng.permutation(KEYPOINTS)
        all_points = np.concatenate([moved, rng.uniform(0, SIZE, (KEYPOINTS - COMMON, 2))])
        all_values = np.concatenate([noisy, descriptors(KEYPOINTS - COMMON)])
        candidates.append(features(all_points[order], all_values[order]))
    query = jax.device_put(features(points, values))
    batch = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *candidates))
    return Data(query, batch, jax.jit(_match)(query, batch))


def _match(query: Features, candidates: Features) -> Matches:
    return jax.vmap(partial(mfvpr.compact, capacity=SLOTS))(mfvpr.match_candidates(query, candidates))


def mfvpr_entries(data: Data) -> list[Entry]:
    """Calls of mfvpr as they are and below `jit`, and the matrix product of its matching alone."""
    histogram, images = mfvpr.HistogramOfShifts(max_bins=len(CENTERS)), (data.query, data.candidates)
    pair = jax.tree.map(lambda leaf: leaf[0], data.matches)

    def product(query: Features, candidates: Features) -> jax.Array:
        return jax.lax.map(lambda descriptors: query.descriptors @ descriptors.T, candidates.descriptors)

    def sum_of_product(query: Features, candidates: Features) -> jax.Array:
        return jax.lax.map(lambda descriptors: (query.descriptors @ descriptors.T).sum(0), candidates.descriptors)

    def both(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.score_candidates(histogram, _match(query, candidates))

    def rounded_product(query: Features, candidates: Features) -> jax.Array:
        query_columns = query.descriptors.astype(jnp.bfloat16).T

        def product(descriptors: jax.Array) -> jax.Array:
            return jnp.matmul(descriptors.astype(jnp.bfloat16), query_columns, preferred_element_type=jnp.float32)

        return jax.lax.map(product, candidates.descriptors)

    score = mfvpr.score_candidates
    return [
        (MATCHING, "bare product (JAX)", ready(jax.jit(product), *images)),
        (MATCHING, "bare product (JAX), not stored", ready(jax.jit(sum_of_product), *images)),
        (MATCHING, "bare product (JAX), bfloat16", ready(jax.jit(rounded_product), *images)),
        (MATCHING, "mfvpr", ready(mfvpr.match_candidates, *images)),
        (MATCHING, "mfvpr, float32", ready(mfvpr.match_candidates, *images, product="float32")),
        (MATCHING, "mfvpr, under jit", ready(jax.jit(mfvpr.match_candidates), *images)),
        (MATCHING, "mfvpr, with ratio", ready(mfvpr.match_candidates, *images, with_ratio=True)),
        (BOTH, "mfvpr", ready(jax.jit(both), *images)),
        (HISTOGRAM, "mfvpr", ready(score, mfvpr.HistogramOfShifts(), data.matches)),
        (ANCHOR, "mfvpr", ready(score, mfvpr.AnchorPoints(), data.matches)),
        (SUM, "mfvpr", ready(score, mfvpr.AggregatedScore(), data.matches)),
        (SHIFT, "mfvpr", ready(mfvpr.HistogramOfShifts().dominant_shift, pair, refine=True)),
    ]


def opencv_entries(data: Data) -> list[Entry]:
    """BFMatcher with cross-check, pair by pair; the score in NumPy, match by match."""
    query, candidates = jax.tree.map(np.asarray, (data.query, data.candidates))
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)

    def match() -> list:
        return [matcher.match(query.descriptors, descriptors) for descriptors in candidates.descriptors]

    def both() -> list[float]:
        pairs = (np.array([(match.queryIdx, match.trainIdx) for match in matches]).T for matches in match())
        return _scores(_histogram_loop, query, candidates, pairs)

    return [(MATCHING, "OpenCV BFMatcher(crossCheck)", match), (BOTH, "OpenCV + NumPy loop", both)]


def faiss_entries(data: Data) -> list[Entry]:
    """Exact search both ways, pair by pair; the score in NumPy, all bins and matches of a pair at once."""
    if find_spec("faiss") is None:
        return []
    import faiss

    query, candidates = jax.tree.map(np.asarray, (data.query, data.candidates))

    def make_index(descriptors: np.ndarray) -> Any:
        index = faiss.IndexFlatIP(DIMENSION)
        index.add(descriptors)  # pyright: ignore[reportCallIssue]
        return index

    query_index = make_index(query.descriptors)

    def match() -> list[tuple[np.ndarray, np.ndarray]]:
        pairs = []
        for descriptors in candidates.descriptors:
            nearest1 = make_index(descriptors).search(query.descriptors, 1)[1][:, 0]
            nearest0 = query_index.search(descriptors, 1)[1][:, 0]
            i = np.flatnonzero(nearest0[nearest1] == np.arange(KEYPOINTS))
            pairs.append((i, nearest1[i]))
        return pairs

    def both() -> list[float]:
        return _scores(_histogram_broadcast, query, candidates, match())

    return [(MATCHING, "FAISS both ways", match), (BOTH, "FAISS + NumPy", both)]


def torch_entries(data: Data) -> list[Entry]:
    """All candidates in one batch; the histogram with separable Gaussians, like mfvpr's."""
    if find_spec("torch") is None:
        return []
    import torch
    from torch import Tensor

    from experiments.benchmark import torch_scores

    # Votes for far bins are denormal floats, which make torch four times as slow. XLA flushes them to zero, so torch
    # does too: its threads inherit the flag from the thread that starts them. NumPy has no such switch.
    torch.set_flush_denormal(True)
    torch.ones(10**7).exp()
    torch.set_flush_denormal(False)

    def tensor(array: Any) -> Tensor:
        return torch.from_numpy(np.array(array))

    query, candidates = jax.tree.map(tensor, (data.query, data.candidates))
    m, centers = data.matches, tensor(CENTERS)
    weights = torch.where(tensor(m.mask), tensor(m.scores0) + tensor(m.scores1), 0.0)
    shifts = tensor(jnp.nan_to_num(m.points1 - m.points0))

    @torch.inference_mode()
    def match() -> tuple[Tensor, Tensor]:
        return torch_scores.match(query.descriptors, candidates.descriptors)

    @torch.inference_mode()
    def histogram(shifts: Tensor, weights: Tensor) -> Tensor:
        torch.set_flush_denormal(True)
        scores = torch_scores.histogram(shifts, weights, centers, SIGMA)
        torch.set_flush_denormal(False)
        return scores

    @torch.inference_mode()
    def both() -> Tensor:
        nearest1, mutual = match()
        moved = torch_scores.take(candidates.keypoints, nearest1) - query.keypoints
        sums = query.scores + torch.gather(candidates.scores, 1, nearest1)
        return histogram(moved, torch.where(mutual, sums, 0.0))

    return [
        (MATCHING, "torch, batched", match),
        (BOTH, "torch, batched", both),
        (HISTOGRAM, "torch, batched", lambda: histogram(shifts, weights)),
    ]


def numpy_entries(data: Data) -> list[Entry]:
    """Scores pair by pair, without padding."""
    m = jax.tree.map(np.asarray, data.matches)
    shifts, weights = m.points1 - m.points0, m.scores0 + m.scores1
    pairs = [(shifts[k][mask], weights[k][mask]) for k, mask in enumerate(m.mask)]
    return [
        (HISTOGRAM, "NumPy, loop over matches", lambda: [_histogram_loop(*pair) for pair in pairs]),
        (HISTOGRAM, "NumPy, broadcast", lambda: [_histogram_broadcast(*pair) for pair in pairs]),
    ]


def _scores(score: Callable, query: Features, candidates: Features, pairs: Iterable[Any]) -> list[float]:
    """Score each candidate by its pairs of features (i of the query, j of the candidate)."""
    return [
        score(candidates.keypoints[k][j] - query.keypoints[i], query.scores[i] + candidates.scores[k][j])
        for k, (i, j) in enumerate(pairs)
    ]


def _histogram_loop(shifts: np.ndarray, weights: np.ndarray) -> float:
    histogram = np.zeros_like(BIN_X)
    for (x, y), weight in zip(shifts, weights, strict=True):
        histogram += weight * np.exp(-((BIN_X - x) ** 2 + (BIN_Y - y) ** 2) / (2 * SIGMA**2))
    return float(histogram.max())


def _histogram_broadcast(shifts: np.ndarray, weights: np.ndarray) -> float:
    squared = (BIN_X - shifts[:, 0, None, None]) ** 2 + (BIN_Y - shifts[:, 1, None, None]) ** 2
    return float((weights[:, None, None] * np.exp(-squared / (2 * SIGMA**2))).sum(0).max())


def run_search(rounds: int | None, out: Path) -> None:
    """Time all libraries on random descriptors."""
    entries = [entry for rows, dimensions in SEARCH_SIZES for entry in search_entries(rows, dimensions)]
    setting = {"sizes": SEARCH_SIZES, "queries": QUERIES, "candidates": CANDIDATES}
    title = f"the {CANDIDATES} nearest of random descriptors, exact"
    compete(entries, rounds or 5, out, title=title, setting=setting, remarks=lambda *_: [])


def search_entries(rows: int, dimensions: int) -> Iterator[Entry]:
    """Calls that return the rows of the nearest descriptors `[Q, CANDIDATES]`."""
    rng = np.random.default_rng(0)
    shapes = (rows, dimensions), (max(QUERIES), dimensions)
    database, queries = (rng.standard_normal(shape, dtype=np.float32) for shape in shapes)
    calls: dict[str, Callable[[np.ndarray], Any]] = {
        "mfvpr": partial(_search_mfvpr, jax.device_put(database)),
        "NumPy": partial(_search_numpy, database),
    }
    if find_spec("faiss"):
        import faiss

        index = faiss.IndexFlatIP(dimensions)
        index.add(database)  # pyright: ignore[reportCallIssue]
        calls["FAISS"] = partial(_search_faiss, index)
    for count in QUERIES:
        step = f"{count} of {rows:,} x {dimensions}"
        yield from ((step, name, partial(call, queries[:count])) for name, call in calls.items())


def _search_mfvpr(database: jax.Array, queries: np.ndarray) -> np.ndarray:
    return np.asarray(mfvpr.retrieve(queries, database, num_candidates=CANDIDATES).indices)


def _search_numpy(database: np.ndarray, queries: np.ndarray) -> np.ndarray:
    products = queries @ database.T
    nearest = np.argpartition(-products, CANDIDATES, axis=1)[:, :CANDIDATES]
    order = np.argsort(-np.take_along_axis(products, nearest, axis=1), axis=1, kind="stable")
    return np.take_along_axis(nearest, order, axis=1)


def _search_faiss(index: Any, queries: np.ndarray) -> np.ndarray:
    return index.search(queries, CANDIDATES)[1]


def run_sweeps(rounds: int | None, out: Path) -> None:
    """Time all grids on the same pairs."""
    teams = {f"NumPy, {count} process{'es' * (count > 1)}": make_team(count) for count in sorted({1, available_cpus()})}
    same = _full_matches()
    flushed = "flushed for all" if flush_denormals() else "flushed for mfvpr only (NumPy needs torch for it)"
    entries = [
        *_histogram_entries("same place", same, teams),  # nearly all matches agree
        *_histogram_entries("other place", _shuffle(same), teams),  # none agree
        *_anchor_entries(same),
    ]
    setting = {"pairs": CANDIDATES, "matches_per_pair": SWEEP_SLOTS, "sigma": SIGMAS, "bin_size": BIN_SIZES}
    setting |= {"denormals": flushed}
    title = f"{CANDIDATES} pairs with {SWEEP_SLOTS} matches each; denormal floats {flushed}"
    compete(entries, rounds or 7, out, title=title, setting=setting, remarks=_sweep_remarks)


def _sweep_remarks(seconds: Seconds, results: Results) -> Iterable[str]:
    for (step, name), taken in seconds.items():
        ours = np.asarray(results[step, "mfvpr"])
        rate = f"{step}, {name}: {ours.size / np.median(taken):,.0f} pair-scores per second"
        theirs = np.asarray(results[step, name]).reshape(ours.shape)
        yield rate if name == "mfvpr" else f"{rate}, scores differ by {np.max(abs(theirs / ours - 1)):.1e} at most"


def _full_matches() -> Matches:
    """The first matches of the pairs of `scores`, which fill all slots."""
    matches = jax.vmap(lambda pair: mfvpr.compact(pair, SWEEP_SLOTS))(make_data().matches)
    return jax.device_put(replace(matches, mask=jnp.ones_like(matches.mask)))


def _shuffle(matches: Matches) -> Matches:
    """Points that do not correspond, as in images of different places, which most pairs of a sweep show."""
    order = np.random.default_rng(0).permuted(np.tile(np.arange(SWEEP_SLOTS), (CANDIDATES, 1)), axis=1)
    return replace(matches, points1=jnp.take_along_axis(matches.points1, order[..., None], axis=1))


def _histogram_entries(place: str, matches: Matches, teams: dict[str, Team]) -> list[Entry]:
    distances = np.quantile(np.asarray(matches.distance), DISTANCE_SHARES).astype(np.float32)
    near = (np.asarray(matches.distance)[:, None] <= distances[:, None]).astype(np.float32)  # [C, 4, K]
    weights = [np.asarray(jax.vmap(partial(match_weights, weight))(matches)) for weight in WEIGHTS]
    near_weights = np.concatenate([weight[:, None] * near for weight in weights], axis=1)
    shifts = np.asarray(matches.points1 - matches.points0)
    entries = []
    for name, axes, team_weights in (
        (GRID, {}, weights[0][:, None]),
        (WEIGHTED_GRID, {"weight": WEIGHTS, "max_distance": distances}, near_weights),
    ):
        step, axes = f"{name}, {place}", {"sigma": SIGMAS, "bin_size": BIN_SIZES} | axes
        entries.append((step, "mfvpr", ready(mfvpr.score_grid, mfvpr.HistogramOfShifts(), matches, **axes)))
        entries += [(step, title, partial(team, shifts, team_weights)) for title, team in teams.items()]
    return entries


def _anchor_entries(matches: Matches) -> list[Entry]:
    axes = {"window": WINDOWS, "tolerance": TOLERANCES}
    return [
        (
            f"{ANCHOR_GRID}, {cells} cells a side",
            "mfvpr",
            ready(mfvpr.score_grid, mfvpr.AnchorPoints(num_bins=cells), matches, **axes),
        )
        for cells in (10, 15, 20)
    ]


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
