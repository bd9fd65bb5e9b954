"""Matching and scoring in mfvpr, and in other libraries as their users would write it.

Each `*_entries` function returns the calls to time, none where its library is not installed.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, Results, Seconds, compete
from mfvpr.core.types import Features, Matches

CANDIDATES, KEYPOINTS, DIMENSION = 50, 700, 512
COMMON = 300  # keypoints that a candidate shares with the query
SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
MATCHING, HISTOGRAM, ANCHOR, SUM = "matching", "histogram", "anchor", "sum"
SHIFT = "refined shift of a pair"
BOTH = "matching + histogram"
SLOTS = 384  # of 700; these pairs need no more
CENTERS = np.arange(-SIZE + BIN / 2, SIZE, BIN, dtype=np.float32)
BIN_X, BIN_Y = np.meshgrid(CENTERS, CENTERS)


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

    def wait(function: Callable, *inputs: Any, **options: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(function(*inputs, **options))

    score = mfvpr.score_candidates
    return [
        (MATCHING, "bare product (JAX)", wait(jax.jit(product), *images)),
        (MATCHING, "bare product (JAX), not stored", wait(jax.jit(sum_of_product), *images)),
        (MATCHING, "bare product (JAX), bfloat16", wait(jax.jit(rounded_product), *images)),
        (MATCHING, "mfvpr", wait(mfvpr.match_candidates, *images)),
        (MATCHING, "mfvpr, float32", wait(mfvpr.match_candidates, *images, product="float32")),
        (MATCHING, "mfvpr, under jit", wait(jax.jit(mfvpr.match_candidates), *images)),
        (MATCHING, "mfvpr, with ratio", wait(mfvpr.match_candidates, *images, with_ratio=True)),
        (
            MATCHING,
            "mfvpr, with ratio, float32",
            wait(mfvpr.match_candidates, *images, with_ratio=True, product="float32"),
        ),
        (BOTH, "mfvpr", wait(jax.jit(both), *images)),
        (HISTOGRAM, "mfvpr", wait(score, mfvpr.HistogramOfShifts(), data.matches)),
        (ANCHOR, "mfvpr", wait(score, mfvpr.AnchorPoints(), data.matches)),
        (SUM, "mfvpr", wait(score, mfvpr.AggregatedScore(), data.matches)),
        (SHIFT, "mfvpr", wait(mfvpr.HistogramOfShifts().dominant_shift, pair, refine=True)),
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
