"""Random and hand-made Features and Matches for the tests, in NumPy."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import mfvpr
from mfvpr import Features, Matches, Pipeline, Shortlist, System
from mfvpr.core import types
from mfvpr.evaluation import rank_dataset
from mfvpr.features import Aggregated, Extractor, Sift
from mfvpr.matchers import MatchSet
from mfvpr.retrieval import Retrieval

SIZE = 336


def evaluate_parts(dataset, extractor, retriever, scorers, *, cache=None, runtime=None, **options):
    """Evaluate a system of these parts; options are fields of `Pipeline` and `System`."""
    of_pipeline = {name: options.pop(name) for name in ("matcher", "candidates") if name in options}
    system = System(Pipeline(extractor, retriever, **of_pipeline), scorers, **options)
    return rank_dataset(dataset, system, cache=cache, runtime=runtime)


@mfvpr.value
class WithoutRatio:
    """A matcher whose matches have no ratio."""

    def __call__(self, features0, features1):
        return mfvpr.match(features0, features1)


def map_system(extractor, describer, scorer=None, candidates=50):
    """A system for a map; the describer is an extractor, or the fitting of a vocabulary.

    The other extractors of tests find the same features in noise: without a ratio, matches are not compared with noise.
    """
    describer = describer if isinstance(describer, Extractor) else Aggregated(extractor, describer)
    matcher = mfvpr.NearestNeighborMatcher() if isinstance(extractor, Sift) else WithoutRatio()
    pipeline = Pipeline(extractor, Retrieval(describer), matcher, candidates)
    return System(pipeline, {"histogram": mfvpr.HistogramOfShifts()} if scorer is None else {"it": scorer})


def unit(array):
    """Rows of unit length, float32."""
    return (array / np.linalg.norm(array, axis=-1, keepdims=True)).astype(np.float32)


def make_features(rng, count, *, capacity=None, dimension=16, size=SIZE, garbage=np.nan):
    """Features of one image with `count` real keypoints; the padding holds `garbage`."""
    capacity = capacity or count

    def pad(real):
        rows = np.full((capacity, *real.shape[1:]), garbage, np.float32)
        rows[:count] = real
        return rows

    return Features(
        keypoints=pad(rng.uniform(0, size, (count, 2))),
        descriptors=pad(unit(rng.normal(size=(count, dimension)))),
        scores=pad(rng.uniform(0.1, 1, count)),
        mask=np.arange(capacity) < count,
        image_size=np.array([size, size], np.float32),
    )


def make_matches(
    points0,
    points1,
    *,
    count0=None,
    count1=None,
    capacity=None,
    garbage=np.nan,
    sizes=((SIZE, SIZE), (SIZE, SIZE)),
    **entries,
):
    """Matches of one pair from real entries; the padding holds `garbage`.

    `entries` have a value per match: distance, scores0, scores1 (0.5 if missing), ratio, confidence, index0, index1.
    """
    real = {
        name: np.asarray(points, np.float32).reshape(-1, 2)
        for name, points in (("points0", points0), ("points1", points1))
    }
    count = len(real["points0"])
    capacity = capacity or max(count, 1)
    entries = {name: values for name, values in entries.items() if values is not None}
    real |= dict.fromkeys(("distance", "scores0", "scores1"), np.full(count, 0.5)) | entries

    def pad(name, values):
        fill, dtype = (-7, np.int32) if name.startswith("index") else (garbage, np.float32)
        rows = np.full((capacity, *np.shape(values)[1:]), fill, dtype)
        rows[:count] = values
        return rows

    return Matches(
        **{name: pad(name, values) for name, values in real.items()},
        mask=np.arange(capacity) < count,
        image_size0=np.array(sizes[0], np.float32),
        image_size1=np.array(sizes[1], np.float32),
        count0=None if count0 is None else np.int32(count0),
        count1=None if count1 is None else np.int32(count1),
    )


def random_matches(rng, count, *, capacity=None, garbage=np.nan, sizes=((SIZE, SIZE), (SIZE, SIZE))):
    """Half of the matches share a shift, half are random; coordinates are on a quarter-pixel grid, exact in float32.

    Half are sure, a quarter of confidence 0.
    """
    points0, anywhere = (rng.integers(0, 4 * np.array(size), (count, 2)) / 4 for size in sizes)
    shift = rng.integers(-240, 240, 2) / 4
    points1 = np.where(rng.random((count, 1)) < 0.5, points0 + shift, anywhere)
    return make_matches(
        points0,
        np.clip(points1, 0, np.array(sizes[1]) - 0.25),
        distance=rng.uniform(0, 2, count),
        scores0=rng.uniform(0.1, 1, count),
        scores1=rng.uniform(0.1, 1, count),
        ratio=rng.uniform(0, 1, count),
        confidence=np.clip(rng.uniform(-1, 3, count), 0, 1),
        index0=rng.permutation(3 * count)[:count],
        index1=rng.permutation(2 * count)[:count],
        count0=3 * count,
        count1=2 * count,
        capacity=capacity,
        garbage=garbage,
        sizes=sizes,
    )


def real(matches):
    """(points0, points1, distance, scores0, scores1) of the real slots, float64."""
    mask = np.asarray(matches.mask)
    names = ("points0", "points1", "distance", "scores0", "scores1")
    return tuple(np.asarray(getattr(matches, name), np.float64)[mask] for name in names)


def per_match(matches, function):
    """`function` of every field that has a row per match, and of no other."""
    rows = types.per_match(matches) | {"mask": matches.mask}
    return replace(matches, **jax.tree.map(function, rows))


def double(tree):
    """Every floating point leaf, and Python number, as float64 of JAX: only below `jax.enable_x64(True)`."""
    wide = lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf  # noqa: E731
    return jax.tree.map(lambda leaf: wide(jnp.asarray(leaf)), tree)


def make_shortlist(rows):
    """A shortlist of these database rows without scores; -1 = none."""
    indices = np.array(rows, np.int32)
    return Shortlist(indices, np.zeros(indices.shape, np.float32), indices >= 0)


def stack(trees):
    """The leaves of equal trees, such as pairs of the same capacity, along a new first axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def fill(folder, names):
    """Small images by name, below a folder."""
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (4, 4)).save(path)
    return folder


def of_query(pairs):
    """The real matches of one query's pairs, one after the other, as `MatchSet` keeps them; and their counts."""
    joined = {
        name: np.concatenate([getattr(pair, name)[pair.mask] for pair in pairs])
        for name in (*types.per_match(pairs[0]), "mask")
    }
    of_candidates = {
        name: np.stack([getattr(pair, name) for pair in pairs])
        for name in types.per_pair(pairs[0])
        if name.endswith("1")
    }
    return replace(pairs[0], **joined, **of_candidates), [int(pair.mask.sum()) for pair in pairs]


def match_set_of(queries, capacity):
    """The matches of queries, from the pairs of each."""
    flat, counts = zip(*map(of_query, queries), strict=True)
    return MatchSet(flat, np.array(counts), capacity)


def local(descriptions):
    """The local features of images, of the only scale."""
    return [description.features for description in descriptions]


def read_golden(name):
    """The arrays of `tests/golden/NAME.npz`."""
    return dict(np.load(Path(__file__).parent / "golden" / f"{name}.npz"))
