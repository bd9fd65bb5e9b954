"""Matching, scores, sweeps and search in mfvpr, and in other libraries as their users would write them.

Each `*_entries` function returns the calls to time, on arrays that are on the device beforehand: mfvpr first, then what
the device needs at least ("bare product", "read"), then torch, and others on a CPU. Libraries that are not installed
are left out.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, compete, ready
from mfvpr.core.types import Features, Matches
from mfvpr.core.weights import WEIGHTS, match_weights

CANDIDATES, KEYPOINTS, DIMENSION = 50, 700, 512
SIZE, BIN, SIGMA, BINS = 336, 15.0, 22.5, 45  # px; bins of the histogram per axis
SLOTS, MATCHES, SHARE = 384, 300, 0.4  # of a pair; share of the keypoints that two views of a place have in common
EXACT = jax.lax.Precision.HIGHEST
SCORERS = {
    "histogram": mfvpr.HistogramOfShifts(max_bins=BINS),
    "anchor": mfvpr.AnchorPoints(),
    "sum": mfvpr.AggregatedScore(),
}
SEARCH_SIZES = ((10_000, 512), (10_000, 4096), (100_000, 512), (100_000, 4096))  # rows and dimensions of the database
QUERIES = (1, 20, 100)
SWEEP_SLOTS = 256
GRID: dict[str, Any] = {"sigma": (5.0, 10.0, 15.0, 22.5, 30.0, 45.0), "bin_size": (5.0, 10.0, 15.0, 20.0)}  # px
WEIGHTED_GRID = GRID | {"weight": ("fs", "dmf", "unit"), "max_distance": (0.5, 0.8, 1.1, 1.4)}
ANCHOR_GRID = {"window": (4.0, 6.0, 8.0, 10.0, 12.0), "tolerance": (1.0, 2.0, 3.0, 4.0, 5.0)}  # cells


def run(rounds: int | None, out: Path) -> None:
    """Time matching and scores of one query with its candidates."""
    sizes = CANDIDATES, KEYPOINTS, DIMENSION
    entries = [*matching_entries(*sizes), *host_matching_entries(*sizes), *ranking_entries(1, *sizes)]
    pair = jax.tree.map(lambda leaf: leaf[0], matches_of(CANDIDATES))
    shift = ready(mfvpr.HistogramOfShifts().dominant_shift, pair, refine=True)
    entries += [*scoring_entries(CANDIDATES), *host_scoring_entries(CANDIDATES), ("shift of a pair", "mfvpr", shift)]
    title = (
        f"1 query x {CANDIDATES} candidates, {KEYPOINTS} features of {DIMENSION} dimensions, {MATCHES} matches a pair"
    )
    compete(entries, rounds or 15, out, title=title)


def run_search(rounds: int | None, out: Path) -> None:
    """Time the exact search of global descriptors."""
    entries = [entry for rows, dimension in SEARCH_SIZES for entry in search_entries(rows, dimension, QUERIES)]
    compete(entries, rounds or 5, out, title=f"the {CANDIDATES} nearest of random descriptors, exact")


def run_sweeps(rounds: int | None, out: Path) -> None:
    """Time grids of the scores' parameters on cached matches."""
    entries: list[Entry] = []
    for place, share in (("same place", 0.9), ("other place", 0.0)):  # shares of the matches that agree
        matches = matches_of(CANDIDATES, SWEEP_SLOTS, SWEEP_SLOTS, share)
        entries += grid_entries(f"6 x 4 histograms, {place}", matches, GRID)
        entries += grid_entries(f"6 x 4 x 3 weights x 4 distances, {place}", matches, WEIGHTED_GRID)
    matches = matches_of(CANDIDATES, SWEEP_SLOTS, SWEEP_SLOTS, 0.9)
    for cells in (10, 15, 20):
        scorer = mfvpr.AnchorPoints(num_bins=cells)
        call = ready(mfvpr.score_grid, scorer, matches, **ANCHOR_GRID)
        entries.append((f"5 x 5 anchors, {cells} cells a side", "mfvpr", call))
    compete(entries, rounds or 7, out, title=f"{CANDIDATES} pairs with {SWEEP_SLOTS} matches each")


@cache
@partial(jax.jit, static_argnums=(0, 1, 2))
def scene(images: int, keypoints: int, dimension: int) -> tuple[Features, Features]:
    """Features of images, and of another view of each: some keypoints move together, the others are new."""
    keys = jax.random.split(jax.random.key(0, impl="rbg"), 6)
    shape, is_common = (images, keypoints), (np.arange(keypoints) < SHARE * keypoints)[None, :, None]
    points, elsewhere = (jax.random.uniform(key, (*shape, 2), maxval=SIZE) for key in keys[:2])
    rows, new_rows = (jax.random.normal(key, (*shape, dimension)) for key in keys[2:4])
    moved = jnp.clip(points + 20 + 4 * jax.random.normal(keys[4], points.shape), 0, SIZE - 1)
    scores, size = jax.random.uniform(keys[5], shape, minval=100, maxval=1000), jnp.full((images, 2), float(SIZE))

    def features(points: jax.Array, rows: jax.Array) -> Features:
        rows = jnp.maximum(rows, 0)  # as D2-Net's
        rows = rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)
        return Features(points, rows, scores, jnp.ones(shape, bool), size)

    order = np.random.default_rng(0).permutation(keypoints)
    view = jnp.where(is_common, moved, elsewhere), jnp.where(is_common, rows + 0.5 * new_rows, new_rows)
    return features(points, rows), features(*(values[:, order] for values in view))


@cache
@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def matches_of(pairs: int, slots: int = SLOTS, real: int = MATCHES, share: float = 1 / 3) -> Matches:
    """Matches of pairs; a share of the matches of a pair agree."""
    keys = jax.random.split(jax.random.key(1, impl="rbg"), 6)
    points, elsewhere = (jax.random.uniform(key, (pairs, slots, 2), maxval=SIZE) for key in keys[:2])
    moved = jnp.clip(points + 20 + 5 * jax.random.normal(keys[2], points.shape), 0, SIZE - 1)
    agrees = np.random.default_rng(0).uniform(size=slots) < share
    points1 = jnp.where(agrees[None, :, None], moved, elsewhere)
    distance, scores0, scores1 = (jax.random.uniform(key, (pairs, slots), minval=0.1) for key in keys[3:])
    mask, size = jnp.broadcast_to(jnp.arange(slots) < real, (pairs, slots)), jnp.full((pairs, 2), float(SIZE))
    return Matches(points, points1, 1.4 * distance, scores0, scores1, mask, size, size)


def with_torch(step: str, function: str, *arrays: jax.Array, **options: Any) -> list[Entry]:
    """A call of `torch_scores` on the same arrays, without a copy; products are of float32, without TF32."""
    on_gpu = jax.default_backend() != "cpu"
    if find_spec("torch") is None:
        return []
    import torch

    from experiments.benchmark import torch_scores

    if on_gpu and not torch.cuda.is_available():
        return []
    torch.set_flush_denormal(True)  # as XLA does; far bins are denormal floats, which make torch four times as slow
    torch.backends.cuda.matmul.allow_tf32 = False
    tensors = [torch.from_dlpack(array) for array in jax.block_until_ready(arrays)]

    def call() -> Any:
        with torch.inference_mode():
            result = getattr(torch_scores, function)(*tensors, **options)
        if on_gpu:
            torch.cuda.synchronize()
        return result

    return [(step, "torch", call)]


def rows_of(features: Features, index: Any) -> Features:
    """Features of some images."""
    return jax.tree.map(lambda field: field[index], features)


def matching_entries(candidates: int, keypoints: int, dimension: int) -> list[Entry]:
    """One query with its candidates: mutual nearest neighbors and their distances."""
    step = f"matching, {candidates} x {keypoints} x {dimension}"
    images, views = scene(candidates, keypoints, dimension)
    query, match = rows_of(views, 0), mfvpr.match_candidates
    sides = query.descriptors, images.descriptors
    product = jax.jit(partial(jnp.einsum, "nd,cmd->cnm", precision=EXACT))
    return [
        (step, "mfvpr", ready(match, query, images)),
        (step, "mfvpr, in one jit", ready(jax.jit(match), query, images)),
        (step, "mfvpr, with ratio", ready(match, query, images, with_ratio=True)),
        (step, "bare product", ready(product, *sides)),
        *with_torch(step, "match_with_distances", *sides),
    ]


def host_matching_entries(candidates: int, keypoints: int, dimension: int) -> list[Entry]:
    """The same by float32 alone, by OpenCV's cross-check, and by FAISS's exact search both ways, pair by pair."""
    step = f"matching, {candidates} x {keypoints} x {dimension}"
    images, views = scene(candidates, keypoints, dimension)
    query = rows_of(views, 0)
    descriptors0, all_descriptors1 = np.asarray(query.descriptors), np.asarray(images.descriptors)
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)

    def match_opencv() -> list:
        return [matcher.match(descriptors0, descriptors1) for descriptors1 in all_descriptors1]

    entries: list[Entry] = [
        (step, "mfvpr, float32", ready(mfvpr.match_candidates, query, images, product="float32")),
        (step, "OpenCV BFMatcher(crossCheck)", match_opencv),
    ]
    if find_spec("faiss"):
        import faiss

        def make_index(descriptors: np.ndarray) -> Any:
            index = faiss.IndexFlatIP(dimension)
            index.add(descriptors)  # pyright: ignore[reportCallIssue]
            return index

        query_index = make_index(descriptors0)

        def match_faiss() -> list[np.ndarray]:
            matches = []
            for descriptors1 in all_descriptors1:
                nearest1 = make_index(descriptors1).search(descriptors0, 1)[1][:, 0]
                nearest0 = query_index.search(descriptors1, 1)[1][:, 0]
                matches.append(np.where(nearest0[nearest1] == np.arange(keypoints), nearest1, -1))
            return matches

        entries.append((step, "FAISS both ways", match_faiss))
    return entries


def scoring_entries(pairs: int) -> list[Entry]:
    """Scores of matches, which a device has to read once."""
    m, entries = matches_of(pairs), []
    arrays = m.points0, m.points1, m.scores0, m.scores1, m.distance, m.mask
    read = jax.jit(lambda *arrays: [jnp.sum(array) for array in arrays])
    for name, scorer in SCORERS.items():
        step, score = f"{name}, {pairs:,} pairs", partial(mfvpr.score_candidates, scorer)
        entries += [(step, "mfvpr", ready(score, m)), (step, "mfvpr, in one jit", ready(jax.jit(score), m))]
        entries += [(step, "read", ready(read, *arrays)), *with_torch(step, "score", *arrays, scorer=name)]
    return entries


def host_scoring_entries(pairs: int) -> list[Entry]:
    """The histogram in NumPy, pair by pair without padding: match by match, and all bins and matches at once."""
    step, m = f"histogram, {pairs:,} pairs", jax.tree.map(np.asarray, matches_of(pairs))
    shifts, weights = m.points1 - m.points0, m.scores0 + m.scores1
    inputs = [(shifts[k][mask], weights[k][mask]) for k, mask in enumerate(m.mask)]
    centers = np.arange(-SIZE + BIN / 2, SIZE, BIN, dtype=np.float32)
    bin_x, bin_y = np.meshgrid(centers, centers)

    def loop(shifts: np.ndarray, weights: np.ndarray) -> float:
        histogram = np.zeros_like(bin_x)
        for (x, y), weight in zip(shifts, weights, strict=True):
            histogram += weight * np.exp(-((bin_x - x) ** 2 + (bin_y - y) ** 2) / (2 * SIGMA**2))
        return float(histogram.max())

    def broadcast(shifts: np.ndarray, weights: np.ndarray) -> float:
        squared = (bin_x - shifts[:, 0, None, None]) ** 2 + (bin_y - shifts[:, 1, None, None]) ** 2
        return float((weights[:, None, None] * np.exp(-squared / (2 * SIGMA**2))).sum(0).max())

    return [
        (step, "NumPy, loop over matches", lambda: [loop(*pair) for pair in inputs]),
        (step, "NumPy, broadcast", lambda: [broadcast(*pair) for pair in inputs]),
    ]


def grid_entries(step: str, matches: Matches, axes: Mapping[str, Sequence[Any]]) -> list[Entry]:
    """A grid of the histogram's settings for all pairs."""
    weights = [jax.vmap(partial(match_weights, WEIGHTS[weight]))(matches) for weight in axes.get("weight", ("fs",))]
    arrays = matches.points1 - matches.points0, jnp.stack(weights, axis=1), matches.distance, matches.mask
    options = {
        "sigmas": axes["sigma"],
        "bin_sizes": axes["bin_size"],
        "max_distances": axes.get("max_distance", (2.0,)),
    }
    call = ready(mfvpr.score_grid, mfvpr.HistogramOfShifts(), matches, **axes)
    return [(step, "mfvpr", call), *with_torch(step, "grid", *arrays, **options)]


def search_entries(rows: int, dimension: int, query_counts: Sequence[int]) -> list[Entry]:
    """The nearest of random global descriptors; on a CPU also in FAISS and NumPy."""
    keys, entries = jax.random.split(jax.random.key(2, impl="rbg"), 2), []
    database, queries = (
        jax.random.normal(key, (count, dimension)) for key, count in zip(keys, (rows, max(query_counts)), strict=True)
    )
    product = jax.jit(partial(jnp.einsum, "qd,nd->qn", precision=EXACT))
    on_host: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    if jax.default_backend() == "cpu":
        on_host["NumPy"] = partial(_search_numpy, np.asarray(database))
        if find_spec("faiss"):
            import faiss

            index = faiss.IndexFlatIP(dimension)
            index.add(np.asarray(database))  # pyright: ignore[reportCallIssue]
            on_host["FAISS"] = lambda queries: index.search(queries, CANDIDATES)[1]  # pyright: ignore[reportCallIssue]
    for count in query_counts:
        step, part = f"search, {count:,} in {rows:,} x {dimension}", queries[:count]
        entries += [
            (step, "mfvpr", ready(mfvpr.retrieve, part, database, num_candidates=CANDIDATES)),
            (step, "bare product", ready(product, part, database)),
            *with_torch(step, "search", part, database, candidates=CANDIDATES),
            *((step, name, partial(search, np.asarray(part))) for name, search in on_host.items()),
        ]
    return entries


def _search_numpy(database: np.ndarray, queries: np.ndarray) -> np.ndarray:
    products = queries @ database.T
    nearest = np.argpartition(-products, CANDIDATES, axis=1)[:, :CANDIDATES]
    order = np.argsort(-np.take_along_axis(products, nearest, axis=1), axis=1, kind="stable")
    return np.take_along_axis(nearest, order, axis=1)


def ranking_entries(queries: int, candidates: int, keypoints: int, dimension: int) -> list[Entry]:
    """From the features of queries and of their candidates to rankings by the histogram."""
    step, (images, views) = f"{queries:,} queries to rankings", scene(candidates, keypoints, dimension)
    rows = jnp.asarray((np.arange(queries)[:, None] + np.arange(candidates)) % candidates)

    def rank(query: Features, candidates: Features) -> jax.Array:
        return mfvpr.rank(mfvpr.score_candidates(SCORERS["histogram"], mfvpr.match_candidates(query, candidates)))

    @jax.jit
    def rank_all(views: Features, images: Features, rows: jax.Array) -> jax.Array:
        return jax.lax.map(lambda row: rank(rows_of(views, row[0]), rows_of(images, row)), rows)

    entries: list[Entry] = [(step, "mfvpr", ready(rank, rows_of(views, 0), images))] if queries == 1 else []
    fields = [field for side in (views, images) for field in (side.keypoints, side.descriptors, side.scores)]
    entries.append((step, "mfvpr, in one jit", ready(rank_all, views, images, rows)))
    return [*entries, *with_torch(step, "rank", rows, *fields)]
