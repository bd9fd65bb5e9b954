"""Results of a device beside float64: loops of the paper's equations, NumPy's products, or the same code on the CPU."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import mfvpr
from experiments.benchmark import networks
from mfvpr.matching.nearest_neighbors import products
from mfvpr.networks.imagenet import preprocess
from mfvpr.retrieval.search import ExactSearch
from mfvpr.scoring.registry import SCORERS
from mfvpr.types import Features, Matches
from tests import oracles

SIZE = 336  # px
TIE = 1e-6  # similarities that differ by less are equal in float32
SIDE = 12  # the keypoints of an image are SIDE^2, as cells of a grid
SMOOTH = {"histogram": mfvpr.HistogramOfShifts(temperature=0.5, max_bins=48),
          "anchor": mfvpr.AnchorPoints(temperature=0.1), "sum": mfvpr.AggregatedScore(temperature=2.0)}  # fmt: skip
NETWORKS = {  # checkpoint -> side of the images in px, result; weights are random unless they are installed
    networks.ALIKED[0]: (320, lambda model, images: model.levels(images / 255)[1]),
    networks.D2NET: (336, lambda model, images: model(preprocess(images, "caffe"))),
    networks.MIXVPR: (320, lambda model, images: model(model.preprocess(images))),
}


@dataclass(frozen=True)
class Check:
    """A result of the device, beside a reference."""

    what: str
    reference: str
    deviation: float  # greatest, relative to the largest entry of the reference
    allowed: float
    differ: int = 0  # entries that differ, without ties of float32
    entries: int = 0

    @property
    def is_exact(self) -> bool:
        """Whether the result is as exact as float32 allows."""
        return self.deviation <= self.allowed and not self.differ


def checks(*, is_small: bool, end: float) -> Iterator[Check]:
    """All checks that begin before the time `end`."""
    for check in (_products, _matching, _scores, _grids, _gradients, _search, _networks):
        if time.monotonic() < end:
            yield from check(is_small)


def in_float64(function: Callable[..., Any], *inputs: Any) -> Any:
    """Result of a function with all numbers in float64 on the CPU, NumPy."""

    def widen(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else leaf if np.isscalar(leaf) else array

    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, function(*jax.tree.map(widen, inputs)))


def compare(what: str, got: Any, expected: Any, allowed: float = 1e-5, reference: str = "float64, CPU") -> Check:
    """Greatest deviation of an array; infinite if one has a NaN where the other has none."""
    got, expected = (np.asarray(values, np.float64) for values in (got, expected))
    same = (got == expected) | (np.isnan(got) & np.isnan(expected))
    difference = np.where(same, 0, np.nan_to_num(np.abs(got - expected), nan=np.inf))
    scale = np.max(np.abs(expected), initial=0, where=np.isfinite(expected)) or 1.0
    return Check(what, reference, float(np.max(difference, initial=0) / scale), allowed)


def features(count: int, dimension: int) -> Features:
    """A query (row 0) and candidates `[count, N]`, NumPy; nearly equal descriptors need all digits of float32."""
    rng, keypoints = np.random.default_rng(dimension), SIDE**2
    query = np.abs(rng.normal(size=(keypoints, dimension)))
    query /= np.linalg.norm(query, axis=1, keepdims=True)
    images = [query]
    for _ in range(count - 1):
        image = query[rng.permutation(keypoints)] + rng.normal(size=query.shape) / dimension**0.5
        image[keypoints // 2 :] = image[: keypoints // 2] + 5e-5 * rng.normal(size=(keypoints // 2, dimension))
        images.append(image / np.linalg.norm(image, axis=1, keepdims=True))
    points, scores = rng.uniform(0, SIZE, (count, keypoints, 2)), rng.uniform(100, 1000, (count, keypoints))
    arrays = (array.astype(np.float32) for array in (points, np.stack(images), scores))
    return Features(*arrays, np.ones((count, keypoints), bool), np.full((count, 2), SIZE, np.float32))


def sides(count: int, dimension: int) -> tuple[Features, Features]:
    """A query `[N]` and its candidates `[count, N]`."""
    images = features(count + 1, dimension)
    return jax.tree.map(lambda field: field[0], images), jax.tree.map(lambda field: field[1:], images)


def matches(count: int, **options: Any) -> Matches:
    """Matches of a query with candidates, NumPy, computed on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, mfvpr.match_candidates(*sides(count, 64), **options))


def _products(_: bool) -> Iterator[Check]:
    query, candidates = (side.descriptors for side in sides(1, 512))
    expected = query.astype(np.float64) @ candidates[0].T.astype(np.float64)
    default = jax.jit(lambda left, right: left @ right.T)(query, candidates[0])
    yield compare("JAX's product, default precision", default, expected, 1.0, "float64, NumPy")
    yield compare("products of descriptors", products(jnp.asarray(query), jnp.asarray(candidates[0])), expected, 1e-6,
                  "float64, NumPy")  # fmt: skip


def _matching(is_small: bool) -> Iterator[Check]:
    settings: list[dict[str, Any]] = [{"product": "float32"}, {"product": "bfloat16", "chunk_size": 1},
                {"with_ratio": True}, {"cross_check": "none"}, {"cross_check": "candidate"},
                {"cross_check": "opencv_legacy"}]  # fmt: skip
    for dimension in (128, 512):
        query, candidates = sides(3 if is_small else 8, dimension)
        for options in settings:
            matches = jax.tree.map(np.asarray, mfvpr.match_candidates(query, candidates, **options))
            is_candidate = options.get("cross_check") == "candidate"
            found = np.where(matches.mask, matches.index0 if is_candidate else matches.index1, -1)
            expected, is_tie, distance = zip(
                *(_nearest(query.descriptors, rows, options.get("cross_check", "mutual"))
                  for rows in candidates.descriptors), strict=True)  # fmt: skip
            same = (found == np.stack(expected)) & matches.mask
            differ = int(np.sum((found != np.stack(expected)) & ~np.stack(is_tie)))
            deviation = np.max(np.abs(matches.distance - np.stack(distance)), initial=0, where=same)
            label = ", ".join(str(value) for name, value in options.items() if name != "chunk_size")
            label = label.replace("True", "with ratio")
            yield Check(f"matches of {dimension} dimensions, {label}", "float64, NumPy", float(deviation), 1e-5, differ,
                        found.size)  # fmt: skip


def _nearest(query: np.ndarray, candidate: np.ndarray, cross_check: str) -> tuple[np.ndarray, ...]:
    """Neighbor of every keypoint (-1 = none), whether float32 may decide otherwise, and the distance."""
    query, candidate = query.astype(np.float64), candidate.astype(np.float64)
    if cross_check == "candidate":
        query, candidate, cross_check = candidate, query, "none"
    similarity, rows = query @ candidate.T, np.arange(len(query))
    forward, backward = similarity.argmax(1), similarity.argmax(0)
    ordered0, ordered1 = np.sort(similarity, axis=1), np.sort(similarity, axis=0)
    is_tie = ordered0[:, -1] - ordered0[:, -2] < TIE
    if cross_check != "none":
        close = (ordered1[-1] - ordered1[-2] < TIE) & (similarity >= ordered1[-2])  # keypoints that share a column
        is_tie |= close.any(1) | close[:, forward].any(0)
    found = forward
    if cross_check == "mutual":
        found = np.where(backward[forward] == rows, forward, -1)
    if cross_check == "opencv_legacy":
        picked = np.where(backward == rows[:, None], similarity, -np.inf)
        found = np.where(np.isfinite(picked.max(1)), picked.argmax(1), -1)
    return found, is_tie, np.linalg.norm(query - candidate[found], axis=1)


def _scores(is_small: bool) -> Iterator[Check]:
    pairs, cells = matches(4 if is_small else 20, with_ratio=True), matches(4, cross_check="candidate")
    scores = {}
    for name, scorer in SCORERS.items():
        if hasattr(scorer, "score_pairs"):  # on the host
            continue
        made, of = (scorer(side=SIDE), cells) if name == "grid" else (scorer(), pairs)
        scores[name] = mfvpr.score_candidates(made, jax.device_put(of))
        yield compare(f"score {name}", scores[name], in_float64(mfvpr.score_candidates, made, of))
    for name, expected in zip(("histogram", "anchor", "sum"), zip(*(_by_loops(pairs, row) for row in range(3)), strict=True),
                              strict=True):  # fmt: skip
        yield compare(f"score {name}", scores[name][:3], expected, 1e-5, "the paper's equations, loops")


def _by_loops(pairs: Matches, row: int) -> tuple[float, ...]:
    """Scores of a pair by the histogram, anchor points and the sum."""
    pair = jax.tree.map(lambda field: field[row], pairs)
    real = pair.mask
    points0, points1, distance = pair.points0[real], pair.points1[real], pair.distance[real]
    weights, size = (pair.scores0 + pair.scores1)[real], (SIZE, SIZE)
    histogram, *_ = oracles.histogram_of_shifts(points1 - points0, weights, size, size)
    anchor = oracles.anchor_points(points0, points1, weights, size, size)
    return histogram.max(), anchor, oracles.aggregated_score(points1 - points0, 2 - distance, size)


def _grids(is_small: bool) -> Iterator[Check]:
    pairs = matches(4 if is_small else 20, with_ratio=True)
    for name, scorer, axes in (
        ("histogram", mfvpr.HistogramOfShifts(), {"sigma": [5.0, 22.5], "bin_size": [10.0, 15.0], "weight": ["fs", "dmf"],
                                                  "max_distance": [0.5, 1.2]}),
        ("anchor", mfvpr.AnchorPoints(), {"window": [4.0, 10.0], "tolerance": [1.0, 3.0]}),
    ):  # fmt: skip
        score = partial(mfvpr.score_grid, scorer, **axes)
        yield compare(f"grid of {name}", score(jax.device_put(pairs)), in_float64(score, pairs))


def _gradients(_: bool) -> Iterator[Check]:
    pairs, (query, candidates) = matches(4), sides(1, 128)
    candidate = jax.tree.map(lambda field: field[0], candidates)
    for name, scorer in SMOOTH.items():

        @jax.jit
        def by_points(pairs: Matches, scorer: Any = scorer) -> Any:
            return jax.grad(lambda points: jnp.sum(jax.vmap(scorer)(replace(pairs, points1=points))))(pairs.points1)

        @jax.jit
        def by_descriptors(query: Features, candidate: Features, scorer: Any = scorer) -> Any:
            def score(descriptors: Any) -> Any:
                return scorer(mfvpr.soft_match(query, replace(candidate, descriptors=descriptors), temperature=0.02))

            return jax.grad(score)(candidate.descriptors)

        yield compare(
            f"gradient of {name}, points",
            by_points(pairs),
            in_float64(by_points, pairs),
            5e-3 if name == "anchor" else 1e-4,
        )
        yield compare(f"gradient of {name}, descriptors", by_descriptors(query, candidate),
                      in_float64(by_descriptors, query, candidate), 5e-3 if name == "anchor" else 1e-4)  # fmt: skip


def _search(is_small: bool) -> Iterator[Check]:
    rng, count = np.random.default_rng(0), 500 if is_small else 100_000
    rows = rng.normal(size=(count, 512))
    rows[count // 2 :] = rows[: count // 2] + 1e-3 * rng.normal(size=(count // 2, 512))  # nearly equal in pairs
    database = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    queries = database[:: count // 20]
    similarity = queries.astype(np.float64) @ database.T.astype(np.float64)
    expected = -np.sort(-similarity, axis=1)[:, :50]
    for name, shortlist in (("retrieve", mfvpr.retrieve(queries, database, num_candidates=50)),
                            ("ExactSearch", ExactSearch().shortlist(queries, database, 50))):  # fmt: skip
        found = np.take_along_axis(similarity, np.asarray(shortlist.indices), axis=1)
        check = compare(f"search, {name}", shortlist.scores, expected, 1e-6, "float64, NumPy")
        yield replace(check, differ=int(np.sum(np.abs(found - expected) > TIE)), entries=found.size)


def _networks(is_small: bool) -> Iterator[Check]:
    for checkpoint, (side, function) in NETWORKS.items():
        if is_small and checkpoint != networks.ALIKED[0]:
            continue
        images = networks.make_images(64 if is_small else side)[:1].astype(np.float32)
        graph, state = nnx.split(networks.make_network(checkpoint)[0])
        run = jax.jit(lambda state, images: function(nnx.merge(graph, state), images))  # noqa: B023
        yield compare(f"{checkpoint}, {images.shape[2]} px", run(state, images), in_float64(run, state, images), 1e-4)
