"""Results of a device beside float64: NumPy, or the same code on the CPU."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import mfvpr
from experiments.benchmark import networks
from mfvpr.baselines.scorers import SCORERS
from mfvpr.core.nearest import products
from mfvpr.core.types import Features, Matches
from mfvpr.networks.layers import preprocess
from mfvpr.retrieval.search import ExactSearch
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import ordered_map

SIZE, CANDIDATES, DIMENSION = 336, 8, 128  # px
SIDE = 12  # the keypoints of an image are SIDE^2, as cells of a grid
TIE = 1e-6  # similarities that differ by less are equal in float32
GRIDS = {
    mfvpr.HistogramOfShifts(): {"sigma": [5.0, 22.5], "weight": ["fs", "dmf"], "max_distance": [0.5, 1.2]},
    mfvpr.AnchorPoints(): {"window": [4.0, 10.0], "tolerance": [1.0, 3.0]},
}
SMOOTH = {  # scorers with a gradient, and the share by which it may deviate
    mfvpr.HistogramOfShifts(temperature=0.5, max_bins=48): 1e-4, mfvpr.AnchorPoints(temperature=0.1): 5e-3,
    mfvpr.AggregatedScore(temperature=2.0): 1e-4,
}  # fmt: skip
NETWORKS = {  # checkpoint -> side of the images in px, result; weights are random unless they are installed
    networks.ALIKED[0]: (320, lambda model, images: model.levels(images / 255)[1]),
    networks.D2NET: (336, lambda model, images: model(preprocess(images, "caffe"))),
    networks.MIXVPR: (320, lambda model, images: model(model.preprocess(images))),
}


class Check(NamedTuple):
    """A check: `compute` returns the device's result and its reference, which deviate by a share `allowed` at most.

    It may return how many entries differ, without ties of float32.
    """

    what: str
    compute: Callable[[], tuple[Any, ...]]
    allowed: float = 1e-5


def check_all(*, is_small: bool) -> list[dict[str, Any]]:
    """Rows of all checks; several run at the same time, since most of the time is compiling."""
    all_checks = [*matching_checks(), *scoring_checks(), *search_checks(), *network_checks(is_small=is_small)]
    return list(ordered_map(check, all_checks, workers=available_cpus()))


def check(task: Check) -> dict[str, Any]:
    """Row of a check: the greatest deviation, relative to the largest entry of the reference."""
    result, expected, differ = (*task.compute(), 0)[:3]
    result, expected = (np.asarray(values, np.float64) for values in (result, expected))
    deviation = float(np.max(np.abs(result - expected)) / (np.max(np.abs(expected)) or 1.0))  # NaN is not exact
    is_exact = "yes" if deviation <= task.allowed and not differ else "NO"
    return {"what": task.what, "deviation": deviation, "allowed": task.allowed, "differ": differ, "exact": is_exact}


def beside_float64(function: Callable[..., Any], *inputs: Any) -> tuple[Any, Any]:
    """Results of a function on the device, and on the CPU with all numbers in float64."""

    def widen(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else array

    result, cpu = np.asarray(function(*jax.device_put(inputs))), jax.devices("cpu")[0]
    with jax.enable_x64(True), jax.default_device(cpu), jax.numpy_dtype_promotion("standard"):
        return result, np.asarray(function(*jax.tree.map(widen, inputs)))


@cache
def images() -> tuple[Features, Features]:
    """A query `[N]` and candidates `[C, N]`, NumPy; nearly equal descriptors need all digits of float32."""
    rng, keypoints = np.random.default_rng(0), SIDE**2
    descriptors = np.abs(rng.normal(size=(1 + CANDIDATES, keypoints, DIMENSION))) / DIMENSION**0.5
    for image in descriptors[1:]:
        image[:] = descriptors[0, rng.permutation(keypoints)] + rng.normal(size=image.shape) / DIMENSION**0.5
        image[keypoints // 2 :] = image[: keypoints // 2] + 5e-5 * rng.normal(size=(keypoints // 2, DIMENSION))
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
    shape = descriptors.shape[:2]
    arrays = rng.uniform(0, SIZE, (*shape, 2)), descriptors, rng.uniform(100, 1000, shape)
    points, descriptors, scores = (array.astype(np.float32) for array in arrays)
    both = Features(points, descriptors, scores, np.ones(shape, bool), np.full((shape[0], 2), SIZE, np.float32))
    return jax.tree.map(lambda field: field[0], both), jax.tree.map(lambda field: field[1:], both)


@cache
def matches(**options: Any) -> Matches:
    """Matches of the query with the candidates, NumPy, computed on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, mfvpr.match_candidates(*images(), **options))


def matching_checks() -> Iterator[Check]:
    """Products and matches."""
    for product in ("bfloat16", "float32"):
        yield Check(f"matches, {product}", partial(match, images(), product))
    query, candidate = images()[0].descriptors, images()[1].descriptors[0]
    expected = query.astype(np.float64) @ candidate.astype(np.float64).T
    yield Check("products of descriptors", lambda: (jax.jit(products)(query, candidate), expected), 1e-6)


def match(images: tuple[Features, Features], product: Any = None, rounded: Any = None) -> tuple[Any, ...]:
    """Distances and ratios of matches, and how many keypoints have another match than `images` in float64."""
    on_device = mfvpr.match_candidates(*(rounded or images), with_ratio=True, product=product, chunk_size=1)
    result = jax.tree.map(np.asarray, on_device)
    neighbors, references = np.where(result.mask, result.index1, -1), []
    query, rows = images[0].descriptors.astype(np.float64), np.arange(neighbors.shape[1])
    for candidate in images[1].descriptors.astype(np.float64):
        similarity = query @ candidate.T
        *_, second, nearest = np.argsort(similarity, axis=1).T
        *_, second0, largest0 = np.sort(similarity, axis=0)
        distance, to_second = (np.linalg.norm(query - candidate[index], axis=1) for index in (nearest, second))
        is_tie = (similarity[rows, nearest] - similarity[rows, second] < TIE) | (largest0 - second0 < TIE)[nearest]
        expected = np.where(similarity.argmax(0)[nearest] == rows, nearest, -1)
        references.append((expected, is_tie, distance, distance / to_second))
    expected, is_tie, *numbers = (np.stack(values) for values in zip(*references, strict=True))
    compared = (neighbors == expected) & (neighbors >= 0) & ~is_tie
    differ = int(np.sum((neighbors != expected) & ~is_tie))
    return np.where(compared, [result.distance, result.ratio], 0), np.where(compared, numbers, 0), differ


def scoring_checks() -> Iterator[Check]:
    """Scores, grids and gradients."""
    pairs, cells = matches(with_ratio=True), matches(cross_check="candidate")
    for name, scorer in SCORERS.items():
        if not hasattr(scorer, "score_pairs"):  # those are on the host
            scorer, of = (scorer(side=SIDE), cells) if name == "grid" else (scorer(), pairs)
            yield Check(f"score {name}", partial(beside_float64, partial(mfvpr.score_candidates, scorer), of))
    for scorer, axes in GRIDS.items():
        compute = partial(beside_float64, partial(mfvpr.score_grid, scorer, **axes), pairs)
        yield Check(f"grid of {type(scorer).__name__}", compute)
    for scorer, allowed in SMOOTH.items():
        compute = partial(beside_float64, jax.jit(partial(_gradient, scorer)), *images())
        yield Check(f"gradient of {type(scorer).__name__}", compute, allowed)


def _gradient(scorer: Any, query: Features, candidates: Features) -> jax.Array:
    """Gradient of a score for the descriptors and points of a candidate, side by side."""
    candidate = jax.tree.map(lambda field: field[0], candidates)

    def score(descriptors: jax.Array, points: jax.Array) -> jax.Array:
        features = replace(candidate, descriptors=descriptors, keypoints=points)
        return scorer(mfvpr.soft_match(query, features, temperature=0.02))

    gradients = jax.grad(score, argnums=(0, 1))(candidate.descriptors, candidate.keypoints)
    return jnp.concatenate([gradient / jnp.max(jnp.abs(gradient)) for gradient in gradients], axis=1)


def search_checks() -> Iterator[Check]:
    """Exact search."""
    rng, count = np.random.default_rng(0), 20_000
    rows = rng.normal(size=(count, DIMENSION))
    rows[count // 2 :] = rows[: count // 2] + 1e-3 * rng.normal(size=(count // 2, DIMENSION))  # equal but for digits
    database = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    queries = database[:: count // 20]
    similarity = queries.astype(np.float64) @ database.T.astype(np.float64)
    expected = -np.sort(-similarity, axis=1)[:, :50]

    def search(shortlist: Callable[..., Any]) -> tuple[Any, ...]:
        candidates = shortlist(queries, database, num_candidates=50)
        similarities = np.take_along_axis(similarity, np.asarray(candidates.indices), axis=1)
        return candidates.scores, expected, int(np.sum(np.abs(similarities - expected) > TIE))

    for name, function in (("retrieve", mfvpr.retrieve), ("ExactSearch", ExactSearch().shortlist)):
        yield Check(f"search, {name}", partial(search, function), 2e-6)


def network_checks(*, is_small: bool) -> Iterator[Check]:
    """Networks on one image; the small check is of ALIKED alone."""
    for checkpoint, (side, function) in [*NETWORKS.items()][: 1 if is_small else None]:
        compute = partial(_network, checkpoint, 64 if is_small else side, function)
        yield Check(f"{checkpoint}, random weights", compute, 1e-4)  # TF32 deviates by more


def _network(checkpoint: str, side: int, function: Callable[..., Any]) -> tuple[Any, Any]:
    images = np.random.default_rng(0).uniform(0, 255, (1, side // 8, side // 8, 3)).repeat(8, axis=1).repeat(8, axis=2)
    graph, state = nnx.split(networks.make_network(checkpoint)[0])
    run = jax.jit(lambda state, images: function(nnx.merge(graph, state), images))
    return beside_float64(run, state, images.astype(np.float32))
