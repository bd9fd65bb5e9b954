"""The projection of descriptors: lengths, dot products, the best one, gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from mfvpr import MatchCount, match, soft_match
from mfvpr.tuning.learning.losses import cross_entropy, mean_loss
from mfvpr.tuning.learning.projection import Projection
from mfvpr.tuning.learning.training import Schedule, fit
from tests.builders import make_features, unit

pytestmark = pytest.mark.thorough


def random_descriptors(seed, count=200, dimension=12):
    """Correlated and far from centered, as real ones."""
    rng = np.random.default_rng(seed)
    return unit(rng.normal(size=(count, dimension)) @ rng.normal(size=(dimension, dimension)) + 1)


project = jax.jit(Projection.__call__)


@given(seed=st.integers(0, 10**6), garbage=st.sampled_from([np.nan, np.inf, 3.0]))
def test_lengths_are_1_and_padding_is_0(seed, garbage):
    rng = np.random.default_rng(seed)
    features = make_features(rng, 9, capacity=12, garbage=garbage)
    projection = Projection(rng.normal(size=(16, 5)).astype(np.float32))
    projected = project(projection, features)
    lengths = np.linalg.norm(projected.descriptors, axis=-1)
    np.testing.assert_allclose(lengths, features.mask.astype(np.float32), rtol=1e-6)
    expected = features.descriptors[:9].astype(np.float64) @ projection.matrix
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(projected.descriptors[:9], expected, atol=3e-6)
    np.testing.assert_array_equal(projected.keypoints, features.keypoints)


def test_full_rank_keeps_dot_products_and_matches():
    query, candidate = (make_features(np.random.default_rng(seed), 30, capacity=35) for seed in (1, 2))
    projection = Projection.principal(query.descriptors[:30], 16)
    rotated = projection(query), projection(candidate)
    products = lambda pair: np.asarray(pair[0].descriptors)[:30] @ np.asarray(pair[1].descriptors)[:30].T  # noqa: E731
    np.testing.assert_allclose(products(rotated), products((query, candidate)), atol=1e-6)
    before, after = jax.jit(match)(query, candidate), jax.jit(match)(*rotated)
    np.testing.assert_array_equal(before.mask, after.mask)
    np.testing.assert_array_equal(np.asarray(before.points1)[before.mask], np.asarray(after.points1)[after.mask])


@pytest.mark.parametrize(("dimension", "count"), [(1, 200), (4, 200), (11, 200), (12, 200), (6, 2)])
def test_principal_directions_are_the_right_singular_vectors_and_orthonormal(dimension, count):
    descriptors = random_descriptors(3, count)
    matrix = np.asarray(Projection.principal(descriptors, dimension).matrix, np.float64)
    _, _, vectors = np.linalg.svd(descriptors.astype(np.float64), full_matrices=False)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(dimension), atol=1e-6)
    vectors = vectors[:dimension]
    np.testing.assert_allclose(np.abs(np.sum(matrix[:, : len(vectors)] * vectors.T, axis=0)), 1, atol=1e-6)


def test_gradients_are_finite_for_zeros_and_padding():
    features = make_features(np.random.default_rng(6), 4, capacity=6)
    features = replace(features, descriptors=np.where(np.arange(6)[:, None] == 0, 0, features.descriptors))
    start = Projection(np.random.default_rng(7).normal(size=(16, 3)).astype(np.float32))

    @jax.jit
    def total(projection, descriptors):
        return jnp.sum(projection(replace(features, descriptors=descriptors)).descriptors)

    for leaf in jax.tree.leaves(jax.grad(total, argnums=(0, 1))(start, features.descriptors)):
        assert np.all(np.isfinite(leaf))
        assert np.any(leaf != 0)
    with jax.enable_x64(True):
        inputs = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), (start, features.descriptors[1:4]))
        features = make_features(np.random.default_rng(6), 3)
        check_grads(total, inputs, order=1, modes=["rev"])


@pytest.mark.parametrize("dimension", [0, 13])
def test_impossible_dimensions_are_refused(dimension):
    with pytest.raises(ValueError, match="expected 1 to 12"):
        Projection.principal(random_descriptors(8), dimension)


def test_a_projection_is_learned_through_soft_matching():
    """Half of the dimensions are noise, and stronger: principal axes keep the noise, gradients find the signal."""
    rng = np.random.default_rng(0)
    count, signal = 12, rng.normal(size=(5, 12, 3))

    def image(place):
        noisy = signal[place] + 0.1 * rng.normal(size=(count, 3))
        values = np.concatenate([noisy, 1.5 * rng.normal(size=(count, 3))], axis=1)
        values /= np.linalg.norm(values, axis=1, keepdims=True)
        return replace(make_features(rng, count, dimension=6), descriptors=values.astype(np.float32))

    queries, database = ([image(place) for place in range(5)] for _ in range(2))
    queries, database = (jax.tree.map(lambda *leaves: np.stack(leaves), *images) for images in (queries, database))
    start = Projection.principal(database.descriptors.reshape(-1, 6), 3)

    def scores(projection):
        def of_pair(query, candidate):
            return MatchCount()(soft_match(projection(query), projection(candidate), temperature=0.1))

        return jax.vmap(lambda query: jax.vmap(lambda candidate: of_pair(query, candidate))(database))(queries)

    correct = np.eye(5, dtype=bool)

    def objective(projection, _):
        return mean_loss(cross_entropy, scores(projection), correct, np.ones_like(correct))

    fitted = fit(start, objective, lambda step: 0, Schedule(optax.adam(0.1), steps=80, every=80))
    scores_of_both = [jax.jit(scores)(projection) for projection in (start, fitted.parameters)]
    losses = [mean_loss(cross_entropy, of_pair, correct, np.ones_like(correct)) for of_pair in scores_of_both]
    recall = [np.mean(np.argmax(of_pair, axis=1) == np.arange(5)) for of_pair in scores_of_both]
    assert losses[1] < 0.5 * losses[0]
    assert recall[1] == 1.0 > recall[0]
