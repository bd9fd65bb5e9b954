"""Who takes part in the benchmark: mfvpr, and its peers written as their users would write them.

Each maker returns (step, name, function) triples, none where its library is not installed.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from mfvpr.types import Features, Matches

CANDIDATES, KEYPOINTS, DIMENSION = 50, 700, 512
COMMON = 300  # keypoints that a candidate shares with the query
SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px

Entry = tuple[str, str, Callable[[], Any]]


@dataclass(frozen=True)
class Lineup:
    """Those who are timed together."""

    title: str
    setting: dict[str, Any]  # for the JSON file
    entries: list[Entry]
    rounds: int  # unless asked for others
    # What the table does not say, from seconds and results by (step, name).
    remarks: Callable[[Mapping[tuple[str, str], list[float]], Mapping[tuple[str, str], Any]], Iterable[str]]


MATCHING, HISTOGRAM, ANCHOR, SUM = "matching", "histogram", "anchor", "sum"
SHIFT = "refined shift of a pair"
BOTH = "matching + histogram"
SLOTS = 384  # of 700: `compact` to what these pairs need
CENTERS = np.arange(-SIZE + BIN / 2, SIZE, BIN, dtype=np.float32)


@dataclass(frozen=True)
class Data:
    """One query and its candidates, non-negative descriptors as D2-Net's; and the pairs' matches."""

    query: Features  # [N, ...]
    candidates: Features  # [C, N, ...]
    matches: Matches  # [C, SLOTS, ...]

    def pairs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """(shifts [n, 2], weights [n]) of each pair, without padding."""
        m = self.matches
        shifts, weights = np.asarray(m.points1) - np.asarray(m.points0), np.asarray(m.scores0) + np.asarray(m.scores1)
        return [(shifts[k][mask], weights[k][mask]) for k, mask in enumerate(np.asarray(m.mask))]


def lineup() -> Lineup:
    """Everyone, on one query and its candidates."""
    data = make_data()
    matches = float(np.asarray(data.matches.mask).sum(1).mean())
    sizes = f"1 query x {CANDIDATES} candidates, {KEYPOINTS} features of {DIMENSION} dimensions"
    return Lineup(
        title=f"{sizes}, {matches:.0f} matches a pair",
        setting={
            "candidates": CANDIDATES, "keypoints": KEYPOINTS, "dimension": DIMENSION, "matches_per_pair": matches,
        },
        entries=[entry for make in ALL for entry in make(data)],
        rounds=15,
        remarks=_remarks,
    )  # fmt: skip


def _remarks(seconds: Mapping[tuple[str, str], list[float]], results: Mapping[tuple[str, str], Any]) -> list[str]:
    anchor, histogram = (np.median(seconds[step, "mfvpr"]) for step in (ANCHOR, HISTOGRAM))
    return [f"anchor / histogram: {anchor / histogram:.2f}"]


def make_data(seed: int = 0) -> Data:
    """COMMON keypoints of the query reappear in every candidate, shifted and noisy; the others are its own."""
    rng = np.random.default_rng(seed)

    def descriptors(count: int) -> np.ndarray:
        return np.maximum(rng.normal(size=(count, DIMENSION)), 0)

    def features(points: np.ndarray, values: np.ndarray) -> Features:
        values = np.maximum(values, 0)
        values /= np.linalg.norm(values, axis=1, keepdims=True)
        scores = rng.uniform(100, 1000, KEYPOINTS)
        size = np.full(2, SIZE)
        arrays = (a.astype(np.float32) for a in (points, values, scores))
        keypoints, unit, scores = arrays
        return Features(keypoints, unit, scores, np.ones(KEYPOINTS, bool), size.astype(np.float32))

    points, values = rng.uniform(40, SIZE - 40, (KEYPOINTS, 2)), descriptors(KEYPOINTS)
    candidates = []
    for _ in range(CANDIDATES):
        common = rng.permutation(KEYPOINTS)[:COMMON]
        moved = points[common] + rng.uniform(-30, 30, 2) + rng.normal(0, 5, (COMMON, 2))
        noisy = values[common] + 0.3 * rng.normal(size=(COMMON, DIMENSION))
        own = KEYPOINTS - COMMON
        order = rng.permutation(KEYPOINTS)
        candidates.append(
            features(
                np.concatenate([moved, rng.uniform(0, SIZE, (own, 2))])[order],
                np.concatenate([noisy, descriptors(own)])[order],
            )
        )
    query = jax.device_put(features(points, values))
    batch = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *candidates))
    return Data(query, batch, jax.jit(_matched)(query, batch))


def _matched(query: Features, candidates: Features) -> Matches:
    return jax.vmap(partial(mfvpr.compact, capacity=SLOTS))(mfvpr.match_candidates(query, candidates))


def of_mfvpr(data: Data) -> list[Entry]:
    """This library as its users call it, and under a `jit` of theirs; the bare matrix product of its matching."""
    histogram, images = mfvpr.HistogramOfShifts(max_bins=len(CENTERS)), (data.query, data.candidates)
    pair = jax.tree.map(lambda leaf: leaf[0], data.matches)

    def product(query: Features, candidates: Features) -> jax.Array:
        return jax.lax.map(lambda descriptors: query.descriptors @ descriptors.T, candidates.descriptors)

    def product_summed(query: Features, candidates: Features) -> jax.Array:
        return jax.lax.map(lambda descriptors: (query.descriptors @ descriptors.T).sum(0), candidates.descriptors)

    def both(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.score_candidates(histogram, _matched(query, candidates))

    def done(function: Callable, *inputs: Any, **options: Any) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(function(*inputs, **options))

    score = mfvpr.score_candidates
    return [
        (MATCHING, "bare product (JAX)", done(jax.jit(product), *images)),
        (MATCHING, "bare product (JAX), not stored", done(jax.jit(product_summed), *images)),
        (MATCHING, "mfvpr", done(mfvpr.match_candidates, *images)),
        (MATCHING, "mfvpr, under jit", done(jax.jit(mfvpr.match_candidates), *images)),
        (MATCHING, "mfvpr, with ratio", done(mfvpr.match_candidates, *images, with_ratio=True)),
        (BOTH, "mfvpr", done(jax.jit(both), *images)),
        (HISTOGRAM, "mfvpr", done(score, mfvpr.HistogramOfShifts(), data.matches)),
        (ANCHOR, "mfvpr", done(score, mfvpr.AnchorPoints(), data.matches)),
        (SUM, "mfvpr", done(score, mfvpr.AggregatedScore(), data.matches)),
        (SHIFT, "mfvpr", done(mfvpr.HistogramOfShifts().dominant_shift, pair, refine=True)),
    ]


def of_opencv(data: Data) -> list[Entry]:
    """BFMatcher with cross-check, one pair at a time; the score in NumPy, one match at a time."""
    query, candidates = np.asarray(data.query.descriptors), np.asarray(data.candidates.descriptors)
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    points0, points1 = np.asarray(data.query.keypoints), np.asarray(data.candidates.keypoints)
    scores0, scores1 = np.asarray(data.query.scores), np.asarray(data.candidates.scores)

    def match() -> list:
        return [matcher.match(query, candidate) for candidate in candidates]

    def both() -> list[float]:
        scores = []
        for k, found in enumerate(match()):
            i, j = np.array([(one.queryIdx, one.trainIdx) for one in found]).T
            scores.append(_histogram_loop(points1[k][j] - points0[i], scores0[i] + scores1[k][j]))
        return scores

    return [(MATCHING, "OpenCV BFMatcher(crossCheck)", match), (BOTH, "OpenCV + NumPy loop", both)]


def of_faiss(data: Data) -> list[Entry]:
    """Exact search both ways, one pair at a time; the score in NumPy, all bins and matches of a pair at once."""
    if find_spec("faiss") is None:
        return []
    import faiss

    query, candidates = np.asarray(data.query.descriptors), np.asarray(data.candidates.descriptors)
    points0, points1 = np.asarray(data.query.keypoints), np.asarray(data.candidates.keypoints)
    scores0, scores1 = np.asarray(data.query.scores), np.asarray(data.candidates.scores)

    def index(descriptors: np.ndarray) -> Any:
        built = faiss.IndexFlatIP(DIMENSION)
        built.add(descriptors)  # pyright: ignore[reportCallIssue]
        return built

    of_query = index(query)

    def match() -> list[tuple[np.ndarray, np.ndarray]]:
        found = []
        for candidate in candidates:
            nearest1 = index(candidate).search(query, 1)[1][:, 0]
            nearest0 = of_query.search(candidate, 1)[1][:, 0]
            i = np.flatnonzero(nearest0[nearest1] == np.arange(KEYPOINTS))
            found.append((i, nearest1[i]))
        return found

    def both() -> list[float]:
        return [
            _histogram_broadcast(points1[k][j] - points0[i], scores0[i] + scores1[k][j])
            for k, (i, j) in enumerate(match())
        ]

    return [(MATCHING, "FAISS both ways", match), (BOTH, "FAISS + NumPy", both)]


def of_numpy(data: Data) -> list[Entry]:
    """Scores of one pair after the other."""
    pairs = data.pairs()
    return [
        (HISTOGRAM, "NumPy, loop over matches", lambda: [_histogram_loop(*pair) for pair in pairs]),
        (HISTOGRAM, "NumPy, broadcast", lambda: [_histogram_broadcast(*pair) for pair in pairs]),
    ]


def of_torch(data: Data) -> list[Entry]:
    """All candidates in one batch; the histogram separable, as here."""
    if find_spec("torch") is None:
        return []
    import torch

    # Far bins get votes too small for normal floats, which makes torch four times as slow. XLA flushes them to zero,
    # so torch may too: its threads inherit the flag from the one that starts them. NumPy has no such switch.
    torch.set_flush_denormal(True)
    torch.ones(10**7).exp()
    torch.set_flush_denormal(False)

    def tensor(array: Any) -> "torch.Tensor":
        return torch.from_numpy(np.array(array))

    query, candidates = tensor(data.query.descriptors), tensor(data.candidates.descriptors)
    points0, points1 = tensor(data.query.keypoints), tensor(data.candidates.keypoints)
    scores0, scores1 = tensor(data.query.scores), tensor(data.candidates.scores)
    m, centers, rows = data.matches, tensor(CENTERS), torch.arange(KEYPOINTS)
    weights = torch.where(tensor(m.mask), tensor(m.scores0) + tensor(m.scores1), 0.0)
    shifts = tensor(jnp.nan_to_num(m.points1 - m.points0))

    @torch.inference_mode()
    def match() -> tuple["torch.Tensor", "torch.Tensor"]:
        similarity = torch.matmul(query, candidates.transpose(1, 2))
        nearest1, nearest0 = similarity.argmax(2), similarity.argmax(1)
        return nearest1, torch.gather(nearest0, 1, nearest1) == rows

    @torch.inference_mode()
    def histogram(shifts: "torch.Tensor", weights: "torch.Tensor") -> "torch.Tensor":
        torch.set_flush_denormal(True)
        votes_x = torch.exp(-0.5 * ((shifts[:, :, 0, None] - centers) / SIGMA) ** 2)  # [C, K, B]
        votes_y = torch.exp(-0.5 * ((shifts[:, :, 1, None] - centers) / SIGMA) ** 2) * weights[:, :, None]
        scores = torch.matmul(votes_y.mT, votes_x).amax((1, 2))
        torch.set_flush_denormal(False)
        return scores

    @torch.inference_mode()
    def both() -> "torch.Tensor":
        nearest1, mutual = match()
        found = torch.gather(points1, 1, nearest1[..., None].expand(-1, -1, 2)) - points0
        return histogram(found, torch.where(mutual, scores0 + torch.gather(scores1, 1, nearest1), 0.0))

    return [
        (MATCHING, "torch, batched", match),
        (BOTH, "torch, batched", both),
        (HISTOGRAM, "torch, batched", lambda: histogram(shifts, weights)),
    ]


ALL = (of_mfvpr, of_opencv, of_faiss, of_torch, of_numpy)

_BIN_X, _BIN_Y = np.meshgrid(CENTERS, CENTERS)


def _histogram_loop(shifts: np.ndarray, weights: np.ndarray) -> float:
    histogram = np.zeros_like(_BIN_X)
    for (x, y), weight in zip(shifts, weights, strict=True):
        histogram += weight * np.exp(-((_BIN_X - x) ** 2 + (_BIN_Y - y) ** 2) / (2 * SIGMA**2))
    return float(histogram.max())


def _histogram_broadcast(shifts: np.ndarray, weights: np.ndarray) -> float:
    squared = (_BIN_X - shifts[:, 0, None, None]) ** 2 + (_BIN_Y - shifts[:, 1, None, None]) ** 2
    return float((weights[:, None, None] * np.exp(-squared / (2 * SIGMA**2))).sum(0).max())
