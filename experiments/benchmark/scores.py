"""Matching, scores, sweeps and search in mfvpr, and in other libraries as their users would write them.

Each `*_entries` function returns the calls to time, on arrays that are on the device beforehand: mfvpr first, then what
the device needs at least ("bare product", "read"), torch, and on a CPU also NumPy, OpenCV and FAISS, if installed.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from experiments.benchmark.harness import Entry, ready, ready_torch, torch_or_none
from mfvpr.core.types import Features, Matches

CANDIDATES = 50  # of a search
SIZE, BIN, SIGMA = 336, 15.0, 22.5  # px
SLOTS, MATCHES, SHARE = 384, 300, 0.4  # of a pair; share of the keypoints that two views of a place have in common
EXACT = jax.lax.Precision.HIGHEST
FIELDS = "points0", "points1", "scores0", "scores1", "distance", "mask"
SCORERS = {
    "histogram": mfvpr.HistogramOfShifts(max_bins=45),
    "anchor": mfvpr.AnchorPoints(),
    "sum": mfvpr.AggregatedScore(),
}


@cache
@partial(jax.jit, static_argnums=(0, 1, 2))
def scene(images: int, keypoints: int, dimension: int) -> tuple[Features, Features]:
    """Features of images, and of another view of each: some keypoints move together, the others are new."""
    keys = jax.random.split(jax.random.key(0, impl="rbg"), 4)
    shape, is_common = (images, keypoints), np.arange(keypoints) < SHARE * keypoints
    rows, new_rows = (jax.random.normal(key, (*shape, dimension)) for key in keys[:2])
    scores, size = jax.random.uniform(keys[2], shape, minval=100, maxval=1000), jnp.full((images, 2), float(SIZE))
    points, moved = _points(keys[3], shape, is_common)

    def features(points: jax.Array, rows: jax.Array) -> Features:
        rows = jnp.maximum(rows, 0)  # as D2-Net's
        rows = rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)
        return Features(points, rows, scores, jnp.ones(shape, bool), size)

    order = np.random.default_rng(0).permutation(keypoints)
    seen_again = jnp.where(is_common[:, None], rows + 0.5 * new_rows, new_rows)
    return features(points, rows), features(moved[:, order], seen_again[:, order])


@cache
@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def matches_of(pairs: int, slots: int = SLOTS, real: int = MATCHES, share: float = 1 / 3) -> Matches:
    """Matches of pairs; a share of the matches of a pair agree."""
    keys = jax.random.split(jax.random.key(1, impl="rbg"), 4)
    points = _points(keys[0], (pairs, slots), np.random.default_rng(0).uniform(size=slots) < share)
    distance, scores0, scores1 = (jax.random.uniform(key, (pairs, slots), minval=0.1) for key in keys[1:])
    mask, size = jnp.broadcast_to(jnp.arange(slots) < real, (pairs, slots)), jnp.full((pairs, 2), float(SIZE))
    return Matches(*points, 1.4 * distance, scores0, scores1, mask, size, size)


def _points(key: jax.Array, shape: tuple[int, int], agrees: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Points `[*shape, 2]`, and others, which stand 20 px off, but for noise, or anywhere."""
    keys = jax.random.split(key, 3)
    points, elsewhere = (jax.random.uniform(key, (*shape, 2), maxval=SIZE) for key in keys[:2])
    moved = jnp.clip(points + 20 + 5 * jax.random.normal(keys[2], points.shape), 0, SIZE - 1)
    return points, jnp.where(agrees[:, None], moved, elsewhere)


def with_torch(step: str, function: str, *arrays: jax.Array, **options: Any) -> list[Entry]:
    """A call of `torch_scores` on the same arrays, without a copy."""
    if (torch := torch_or_none()) is None:
        return []
    from experiments.benchmark import torch_scores

    tensors = [torch.from_dlpack(array) for array in jax.block_until_ready(arrays)]
    return [(step, "torch", ready_torch(getattr(torch_scores, function), *tensors, **options))]


def rows_of(features: Features, index: Any) -> Features:
    """Features of some images."""
    return jax.tree.map(lambda field: field[index], features)


def product_entries(side: int) -> list[Entry]:
    """Product of square matrices."""
    left, step = jax.random.normal(jax.random.key(3), (side, side)), f"product {side} x {side}"
    product = jax.jit(partial(jnp.matmul, precision=EXACT))
    return [(step, "JAX", ready(product, left, left)), *with_torch(step, "product", left, left)]


def matching_entries(candidates: int, keypoints: int, dimension: int) -> list[Entry]:
    """One query with its candidates: mutual nearest neighbors and their distances."""
    step = f"matching, {candidates} x {keypoints} x {dimension}"
    images, views = scene(candidates, keypoints, dimension)
    query, match = rows_of(views, 0), mfvpr.match_candidates
    sides = query.descriptors, images.descriptors
    product = jax.jit(partial(jnp.einsum, "nd,cmd->cnm", precision=EXACT))
    entries = [
        (step, "mfvpr", ready(match, query, images)),
        (step, "mfvpr, in one jit", ready(jax.jit(match), query, images)),
        (step, "mfvpr, with ratio", ready(match, query, images, with_ratio=True)),
        (step, "bare product", ready(product, *sides)),
        *with_torch(step, "match_with_distances", *sides),
    ]
    if jax.default_backend() == "cpu":
        on_host = [np.asarray(side) for side in sides]
        entries += [
            (step, "mfvpr, float32", ready(match, query, images, product="float32")),
            (step, "OpenCV BFMatcher(crossCheck)", partial(_match_opencv, *on_host)),
        ]
    return entries


def _match_opencv(query: np.ndarray, candidates: np.ndarray) -> list[Any]:
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    return [matcher.match(query, candidate) for candidate in candidates]


def scoring_entries(pairs: int) -> list[Entry]:
    """Scores of matches, which a device has to read once."""
    matches, entries = matches_of(pairs), list[Entry]()
    arrays = [getattr(matches, name) for name in FIELDS]
    read = jax.jit(lambda *arrays: [jnp.sum(array) for array in arrays])
    for name, scorer in SCORERS.items():
        step, score = f"{name}, {pairs:,} pairs", partial(mfvpr.score_candidates, scorer)
        entries += [
            (step, "mfvpr", ready(score, matches)),
            (step, "mfvpr, in one jit", ready(jax.jit(score), matches)),
            (step, "read", ready(read, *arrays)),
            *with_torch(step, "score", *arrays, scorer=name),
        ]
    if jax.default_backend() == "cpu":
        m = jax.tree.map(np.asarray, matches)
        pairs_on_host = [((m.points1 - m.points0)[k][mask], (m.scores0 + m.scores1)[k][mask])
                         for k, mask in enumerate(m.mask)]  # fmt: skip
        entries.append((f"histogram, {pairs:,} pairs", "NumPy, loop over matches", partial(_loop, pairs_on_host)))
    return entries


def _loop(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[float]:
    """Tallest bins of pairs with their shifts and weights."""
    bin_x, bin_y = np.meshgrid(*[np.arange(-SIZE + BIN / 2, SIZE, BIN, dtype=np.float32)] * 2)
    tallest = []
    for shifts, weights in pairs:
        histogram = np.zeros_like(bin_x)
        for (x, y), weight in zip(shifts, weights, strict=True):
            histogram += weight * np.exp(-((bin_x - x) ** 2 + (bin_y - y) ** 2) / (2 * SIGMA**2))
        tallest.append(float(histogram.max()))
    return tallest


def shift_entries() -> list[Entry]:
    """The refined shift of a pair."""
    pair = jax.tree.map(lambda leaf: leaf[0], matches_of(CANDIDATES))
    return [("shift of a pair", "mfvpr", ready(mfvpr.HistogramOfShifts().dominant_shift, pair, refine=True))]


def grid_entries(step: str, axes: Mapping[str, Sequence[Any]], *of_matches: Any) -> list[Entry]:
    """A grid of the histogram's settings for the pairs of `matches_of`."""
    matches = matches_of(*of_matches)
    arrays = (getattr(matches, name) for name in FIELDS)
    call = ready(mfvpr.score_grid, mfvpr.HistogramOfShifts(), matches, **axes)
    return [(step, "mfvpr", call), *with_torch(step, "grid", *arrays, **axes)]


def anchor_entries(cells: int, *of_matches: Any) -> list[Entry]:
    """A grid of the settings of anchor points, in cells, for the pairs of `matches_of`."""
    axes = {"window": (4.0, 6.0, 8.0, 10.0, 12.0), "tolerance": (1.0, 2.0, 3.0, 4.0, 5.0)}
    call = ready(mfvpr.score_grid, mfvpr.AnchorPoints(num_bins=cells), matches_of(*of_matches), **axes)
    return [(f"5 x 5 anchors, {cells} cells a side", "mfvpr", call)]


def search_entries(rows: int, dimension: int, query_counts: Sequence[int]) -> list[Entry]:
    """The nearest of random global descriptors, exact."""
    keys, entries = jax.random.split(jax.random.key(2, impl="rbg"), 2), list[Entry]()
    database, queries = (
        jax.random.normal(key, (count, dimension)) for key, count in zip(keys, (rows, max(query_counts)), strict=True)
    )
    product = jax.jit(partial(jnp.einsum, "qd,nd->qn", precision=EXACT))
    on_host: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    if jax.default_backend() == "cpu":
        on_host["NumPy"] = partial(_search_numpy, np.asarray(database))
        if find_spec("faiss"):
            import faiss

            index: Any = faiss.IndexFlatIP(dimension)
            index.add(np.asarray(database))
            on_host["FAISS"] = lambda queries: index.search(queries, CANDIDATES)[1]
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
