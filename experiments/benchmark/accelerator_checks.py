"""Results of a device beside float64: loops of the paper's equations, NumPy's products, or the same code on the CPU."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

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
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.threads import ordered_map
from tests import oracles

SIZE = 336  # px
TIE = 1e-6  # similarities that differ by less are equal in float32
SIDE = 12  # the keypoints of an image are SIDE^2, as cells of a grid
MATCHING: dict[str, dict[str, Any]] = {
    "float32": {"product": "float32"}, "bfloat16": {"product": "bfloat16", "chunk_size": 1},
    "one after the other": {"chunk_size": 1}, "without cross-check": {"cross_check": "none"},
}  # fmt: skip
GRIDS = (
    (mfvpr.HistogramOfShifts(), {"sigma": [5.0, 22.5], "bin_size": [10.0, 15.0], "weight": ["fs", "dmf"],
                                 "max_distance": [0.5, 1.2]}),
    (mfvpr.AnchorPoints(), {"window": [4.0, 10.0], "tolerance": [1.0, 3.0]}),
)  # fmt: skip
SMOOTH = {  # scorers with a gradient, and the share by which it may deviate
    "histogram": (mfvpr.HistogramOfShifts(temperature=0.5, max_bins=48), 1e-4),
    "anchor": (mfvpr.AnchorPoints(temperature=0.1), 5e-3),
    "sum": (mfvpr.AggregatedScore(temperature=2.0), 1e-4),
}
NETWORKS = {  # checkpoint -> side of the images in px, result; weights are random unless they are installed
    networks.ALIKED[0]: (320, lambda model, images: model.levels(images / 255)[1]),
    networks.D2NET: (336, lambda model, images: model(preprocess(images, "caffe"))),
    networks.MIXVPR: (320, lambda model, images: model(model.preprocess(images))),
}


Images = tuple[Features, Features]  # a query `[N]`, and its candidates `[C, N]`


class Task(NamedTuple):
    """A check: `compute` returns the device's result and its reference, which deviate by a share `allowed` at most.

    It may return how many entries differ, and of how many, without ties of float32.
    """

    what: str
    compute: Callable[[], tuple[Any, ...]]
    allowed: float = 1e-5
    reference: str = "float64, CPU"


def checks(*, is_small: bool, end: float) -> Iterator[dict[str, Any]]:
    """Rows of all checks that begin before the time `end`; several at the same time, since most of it is compiling."""
    tasks = [task for part in PARTS for task in part(is_small)]
    return ordered_map(partial(check, end=end), tasks, workers=available_cpus())


def check(task: Task, end: float) -> dict[str, Any]:
    row: dict[str, Any] = {"what": task.what, "reference": task.reference}
    if time.monotonic() > end:
        return row | {"exact": "skipped: out of time"}
    try:
        got, expected, differ, entries = (*task.compute(), 0, 0)[:4]
    except Exception as error:  # the other checks go on
        return row | {"exact": f"failed: {error!r}"[:80]}
    deviation = relative_deviation(got, expected)
    is_exact = deviation <= task.allowed and not differ
    return row | {"deviation": deviation, "allowed": task.allowed, "differ": differ, "entries": entries,
                  "exact": "yes" if is_exact else "NO"}  # fmt: skip


def relative_deviation(got: Any, expected: Any) -> float:
    """Greatest deviation, relative to the largest entry; infinite if one has a NaN where the other has none."""
    got, expected = (np.asarray(values, np.float64) for values in (got, expected))
    same = (got == expected) | (np.isnan(got) & np.isnan(expected))
    difference = np.where(same, 0, np.nan_to_num(np.abs(got - expected), nan=np.inf))
    scale = np.max(np.abs(expected), initial=0, where=np.isfinite(expected)) or 1.0
    return float(np.max(difference, initial=0) / scale)


def beside_float64(function: Callable[..., Any], *inputs: Any) -> tuple[Any, Any]:
    """Results of a function on the device, and on the CPU with all numbers in float64."""

    def widen(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else array

    result = np.asarray(function(*jax.device_put(inputs)))
    cpu = jax.devices("cpu")[0]
    with jax.enable_x64(True), jax.default_device(cpu), jax.numpy_dtype_promotion("standard"):
        return result, np.asarray(function(*jax.tree.map(widen, inputs)))


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
    points, descriptors, scores = (array.astype(np.float32) for array in (points, np.stack(images), scores))
    return Features(
        points, descriptors, scores, np.ones((count, keypoints), bool), np.full((count, 2), SIZE, np.float32)
    )


def sides(count: int, dimension: int) -> Images:
    """A query `[N]` and its candidates `[count, N]`."""
    images = features(count + 1, dimension)
    return jax.tree.map(lambda field: field[0], images), jax.tree.map(lambda field: field[1:], images)


def matches(count: int, **options: Any) -> Matches:
    """Matches of a query with candidates, NumPy, computed on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, mfvpr.match_candidates(*sides(count, 64), **options))


def product_tasks(_: bool) -> Iterator[Task]:
    query, candidate = (side.descriptors for side in sides(1, 512))
    expected = query.astype(np.float64) @ candidate[0].T.astype(np.float64)
    for what, product, allowed in (("JAX's product, default precision", lambda left, right: left @ right.T, np.inf),
                                   ("products of descriptors", products, 1e-6)):  # fmt: skip
        compute = partial(lambda product: (jax.jit(product)(query, candidate[0]), expected), product)
        yield Task(what, compute, allowed, "float64, NumPy")


def matching_tasks(is_small: bool) -> Iterator[Task]:
    for dimension in (128,) if is_small else (128, 512):
        for title, options in MATCHING.items():
            compute = partial(match, sides(3 if is_small else 8, dimension), options)
            yield Task(f"matches of {dimension} dimensions, {title}", compute, 1e-5, "float64, NumPy")


def match(images: Images, options: dict[str, Any], matched: Images | None = None) -> tuple[Any, ...]:
    """Distances and ratios of matches, and how many keypoints have another match than `images` in float64."""
    matches = jax.tree.map(np.asarray, mfvpr.match_candidates(*(matched or images), with_ratio=True, **options))
    found, references = np.where(matches.mask, matches.index1, -1), []
    query, rows = images[0].descriptors.astype(np.float64), np.arange(found.shape[1])
    for candidate in images[1].descriptors.astype(np.float64):
        similarity = query @ candidate.T
        *_, second, expected = np.argsort(similarity, axis=1).T
        distance, to_second = (np.linalg.norm(query - candidate[index], axis=1) for index in (expected, second))
        is_tie = similarity[rows, expected] - similarity[rows, second] < TIE
        if "cross_check" not in options:
            *_, second0, largest0 = np.sort(similarity, axis=0)
            is_tie |= (largest0 - second0 < TIE)[expected]
            expected = np.where(similarity.argmax(0)[expected] == rows, expected, -1)
        references.append((expected, is_tie, distance, distance / to_second))
    expected, is_tie, *numbers = (np.stack(values) for values in zip(*references, strict=True))
    compared = (found == expected) & (found >= 0) & ~is_tie
    differ = int(np.sum((found != expected) & ~is_tie))
    return np.where(compared, [matches.distance, matches.ratio], 0), np.where(compared, numbers, 0), differ, found.size


def score_tasks(is_small: bool) -> Iterator[Task]:
    pairs, cells = matches(4 if is_small else 20, with_ratio=True), matches(4, cross_check="candidate")
    for name, scorer in SCORERS.items():
        if hasattr(scorer, "score_pairs"):  # on the host
            continue
        scorer, of = (scorer(side=SIDE), cells) if name == "grid" else (scorer(), pairs)
        yield Task(f"score {name}", partial(beside_float64, partial(mfvpr.score_candidates, scorer), of))
        if name in ("histogram", "anchor", "sum"):
            compute = partial(_beside_loops, name, scorer, pairs)
            yield Task(f"score {name}", compute, reference="the paper's equation, loops")


def _beside_loops(name: str, scorer: Any, pairs: Matches) -> tuple[Any, Any]:
    pairs = jax.tree.map(lambda field: field[:3], pairs)
    expected, size = [], (SIZE, SIZE)
    for row, real in enumerate(pairs.mask):
        points0, points1, distance, *scores = (
            values[row][real] for values in (pairs.points0, pairs.points1, pairs.distance, pairs.scores0, pairs.scores1)
        )
        weights, shifts = np.sum(scores, axis=0, dtype=np.float64), points1.astype(np.float64) - points0
        expected.append({
            "histogram": lambda: oracles.histogram_of_shifts(shifts, weights, size, size)[0].max(),  # noqa: B023
            "anchor": lambda: oracles.anchor_points(points0, points1, weights, size, size),  # noqa: B023
            "sum": lambda: oracles.aggregated_score(shifts, 2 - distance.astype(np.float64), size),  # noqa: B023
        }[name]())  # fmt: skip
    return mfvpr.score_candidates(scorer, jax.device_put(pairs)), expected


def grid_tasks(is_small: bool) -> Iterator[Task]:
    pairs = matches(4 if is_small else 20, with_ratio=True)
    for scorer, axes in GRIDS:
        compute = partial(beside_float64, partial(mfvpr.score_grid, scorer, **axes), pairs)
        yield Task(f"grid of {type(scorer).__name__}", compute)


def gradient_tasks(_: bool) -> Iterator[Task]:
    pairs, (query, candidates) = matches(4), sides(1, 128)
    candidate = jax.tree.map(lambda field: field[0], candidates)

    def by_points(scorer: Any, pairs: Matches) -> Any:
        return jax.grad(lambda points: jnp.sum(jax.vmap(scorer)(replace(pairs, points1=points))))(pairs.points1)

    def by_descriptors(scorer: Any, query: Features, candidate: Features) -> Any:
        def score(descriptors: Any) -> Any:
            return scorer(mfvpr.soft_match(query, replace(candidate, descriptors=descriptors), temperature=0.02))

        return jax.grad(score)(candidate.descriptors)

    for name, (scorer, allowed) in SMOOTH.items():
        for entries, function, inputs in (("points", by_points, (pairs,)),
                                          ("descriptors", by_descriptors, (query, candidate))):  # fmt: skip
            compute = partial(beside_float64, jax.jit(partial(function, scorer)), *inputs)
            yield Task(f"gradient of {name}, {entries}", compute, allowed)


def search_tasks(is_small: bool) -> Iterator[Task]:
    rng, count = np.random.default_rng(0), 500 if is_small else 100_000
    rows = rng.normal(size=(count, 512))
    rows[count // 2 :] = rows[: count // 2] + 1e-3 * rng.normal(size=(count // 2, 512))  # nearly equal in pairs
    database = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    queries = database[:: count // 20]
    similarity = queries.astype(np.float64) @ database.T.astype(np.float64)
    expected = -np.sort(-similarity, axis=1)[:, :50]

    def search(shortlist: Callable[..., Any], **options: Any) -> tuple[Any, ...]:
        candidates = shortlist(queries, database, num_candidates=50)
        found = np.take_along_axis(similarity, np.asarray(candidates.indices), axis=1)
        return candidates.scores, expected, int(np.sum(np.abs(found - expected) > TIE)), found.size

    for function in (mfvpr.retrieve, ExactSearch().shortlist):
        yield Task(f"search, {function.__name__}", partial(search, function), 2e-6, "float64, NumPy")


def network_tasks(is_small: bool) -> Iterator[Task]:
    for checkpoint, (side, function) in NETWORKS.items():
        if not is_small or checkpoint == networks.ALIKED[0]:
            compute = partial(_network, checkpoint, 64 if is_small else side, function)
            yield Task(f"{checkpoint}, random weights", compute)


def _network(checkpoint: str, side: int, function: Callable[..., Any]) -> tuple[Any, Any]:
    images = np.random.default_rng(0).uniform(0, 255, (1, side // 8, side // 8, 3)).repeat(8, axis=1).repeat(8, axis=2)
    graph, state = nnx.split(networks.make_network(checkpoint)[0])
    run = jax.jit(lambda state, images: function(nnx.merge(graph, state), images))
    return beside_float64(run, state, images.astype(np.float32))


PARTS = (product_tasks, matching_tasks, network_tasks, score_tasks, grid_tasks, gradient_tasks, search_tasks)
