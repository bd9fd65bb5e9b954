"""Results of a device beside float64: NumPy, or the same code on the CPU."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

import mfvpr
from experiments.benchmark import networks
from experiments.benchmark.harness import Rows
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
# Scorers with a gradient, and the share by which it may deviate.
SMOOTH = {mfvpr.HistogramOfShifts(temperature=0.5, max_bins=48): 1e-4, mfvpr.AggregatedScore(temperature=2.0): 1e-4}
SMOOTH[mfvpr.AnchorPoints(temperature=0.1)] = 5e-3
NETWORKS = {  # checkpoint -> side of the images in px, result; weights are random unless they are installed
    networks.ALIKED: (320, lambda model, images: model.levels(images / 255)[1]),
    networks.D2NET: (336, lambda model, images: model(preprocess(images, "caffe"))),
    networks.MIXVPR: (320, lambda model, images: model(model.preprocess(images))),
}


# Name; a function that returns the device's result, its reference, and maybe how many entries differ without a tie of
# float32; and the largest allowed deviation, relative.
Check = tuple[str, Callable[[], tuple[Any, ...]], float]


def check_all(_: int) -> Rows:
    """Rows of all checks; several run at the same time, since most of the time is compiling."""
    checks = [*matching_checks(), *scoring_checks(), *search_checks(), *network_checks()]
    return list(ordered_map(check, checks, workers=available_cpus()))


def check(task: Check) -> dict[str, Any]:
    """Row of a check: the greatest deviation, relative to the largest entry of the reference."""
    name, compute, allowed = task
    result, expected, differ = (*compute(), 0)[:3]
    result, expected = (np.asarray(values, np.float64) for values in (result, expected))
    deviation = float(np.max(np.abs(result - expected)) / (np.max(np.abs(expected)) or 1.0))  # NaN is not exact
    is_exact = "yes" if deviation <= allowed and not differ else "NO"
    return {"check": name, "exact": is_exact, "deviation": deviation, "allowed": allowed, "differ": differ}


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


def beside_float64(name: str, function: Callable[..., Any], *inputs: Any, allowed: float = 1e-5) -> Check:
    """Check results of a function on the device beside those on the CPU with all numbers in float64."""

    def widen(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else array

    def compute() -> tuple[Any, ...]:
        result, cpu = np.asarray(function(*jax.device_put(inputs))), jax.devices("cpu")[0]
        with jax.enable_x64(True), jax.default_device(cpu), jax.numpy_dtype_promotion("standard"):
            return result, np.asarray(function(*jax.tree.map(widen, inputs)))

    return name, compute, allowed


def matching_checks() -> Iterator[Check]:
    """Products and matches."""
    for product in ("bfloat16", "float32"):
        yield f"matches, {product}", partial(match, images(), product), 1e-5
    descriptors = images()[0].descriptors, images()[1].descriptors[0]
    yield beside_float64("products of descriptors", jax.jit(products), *descriptors, allowed=1e-6)


def match(images: tuple[Features, Features], product: Any = None, rounded: Any = None) -> tuple[Any, ...]:
    """Distances and ratios of matches, and how many keypoints have another match than `images` in float64."""
    on_device = mfvpr.match_candidates(*(rounded or images), with_ratio=True, product=product, chunk_size=1)
    result = jax.tree.map(np.asarray, on_device)
    query, candidates = (side.descriptors.astype(np.float64) for side in images)
    similarity = query @ candidates.swapaxes(1, 2)  # [C, N0, N1]
    nearest, (second, largest) = similarity.argmax(2), np.moveaxis(np.sort(similarity, axis=2)[..., -2:], 2, 0)
    second0, largest0 = (np.sort(similarity, axis=1)[:, rank] for rank in (-2, -1))
    back, gap0 = (np.take_along_axis(each, nearest, 1) for each in (similarity.argmax(1), largest0 - second0))
    expected = np.where(back == np.arange(len(query)), nearest, -1)
    neighbors, is_tie = np.where(result.mask, result.index1, -1), (largest - second < TIE) | (gap0 < TIE)
    compared = (neighbors == expected) & (neighbors >= 0) & ~is_tie
    distance, to_second = (np.sqrt(2 - 2 * each) for each in (largest, second))
    numbers = [distance, distance / to_second]
    differ = int(np.sum((neighbors != expected) & ~is_tie))
    return np.where(compared, [result.distance, result.ratio], 0), np.where(compared, numbers, 0), differ


def scoring_checks() -> Iterator[Check]:
    """Scores, grids and gradients."""
    pairs, cells = matches(with_ratio=True), matches(cross_check="candidate")
    for name, scorer in SCORERS.items():
        if not hasattr(scorer, "score_pairs"):  # those are on the host
            scorer, of = (scorer(side=SIDE), cells) if name == "grid" else (scorer(), pairs)
            yield beside_float64(f"score {name}", partial(mfvpr.score_candidates, scorer), of)
    for scorer, axes in GRIDS.items():
        yield beside_float64(f"grid of {type(scorer).__name__}", partial(mfvpr.score_grid, scorer, **axes), pairs)
    for scorer, allowed in SMOOTH.items():
        gradient = jax.jit(partial(_gradient, scorer))
        yield beside_float64(f"gradient of {type(scorer).__name__}", gradient, *images(), allowed=allowed)


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
        """Scores, and similarities of the rows in float64."""
        result = shortlist(queries, database, num_candidates=50)
        similarities = np.take_along_axis(similarity, np.asarray(result.indices), axis=1)
        return np.stack([result.scores, similarities]), np.stack([expected] * 2)

    for name, function in (("retrieve", mfvpr.retrieve), ("ExactSearch", ExactSearch().shortlist)):
        yield f"search, {name}", partial(search, function), TIE


def network_checks() -> Iterator[Check]:
    """Networks on one image; on a CPU ALIKED alone, on a small one."""
    is_small = jax.default_backend() == "cpu"
    for checkpoint, (side, function) in [*NETWORKS.items()][: 1 if is_small else None]:
        cells = np.random.default_rng(0).uniform(0, 255, (1, *[(64 if is_small else side) // 8] * 2, 3))
        graph, state = nnx.split(networks.make_network(checkpoint)[0])
        run = jax.jit(lambda state, images, graph=graph, function=function: function(nnx.merge(graph, state), images))
        image = cells.repeat(8, axis=1).repeat(8, axis=2).astype(np.float32)
        yield beside_float64(checkpoint, run, state, image, allowed=1e-4)  # TF32 deviates by more
