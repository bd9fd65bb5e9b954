"""Soft matching against the float64 loop, its limit, and where it degenerates; the ratio of the two nearest."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import match, soft_match
from mfvpr.core.types import per_keypoint
from tests import score_oracles
from tests.builders import double, make_features, stack

pytestmark = pytest.mark.thorough

soft = jax.jit(soft_match)
with_ratio = jax.jit(partial(match, with_ratio=True), static_argnames="cross_check")


@st.composite
def feature_pairs(draw):
    """Two images of 20 slots; some of their descriptors are not finite, some shared, some all the same."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    pair = [make_features(rng, draw(st.sampled_from([0, 1, 2, 18])), capacity=20) for _ in range(2)]
    kind = draw(st.sampled_from(["random", "shared", "same", "broken"]))
    for features in pair:
        if kind == "shared":
            features.descriptors[features.mask] = pair[0].descriptors[rng.integers(0, 3)] if pair[0].mask.any() else 0
        if kind == "same":
            features.descriptors[features.mask] = np.eye(16, dtype=np.float32)[0]
        if kind == "broken":
            features.descriptors[rng.integers(0, 20, 3), 0] = np.inf
    return pair


def shuffled(features, order):
    """The same image with its slots in another order."""
    return replace(features, **{name: values[order] for name, values in per_keypoint(features).items()})


def usable(features):
    """Real keypoints whose descriptor is finite."""
    return features.mask & np.isfinite(features.descriptors).all(axis=1)


@given(feature_pairs(), st.sampled_from([0.01, 0.1, 2.0]))
def test_smooth_agree_with_the_loop(pair, temperature):
    features0, features1 = pair
    rows0, rows1 = usable(features0), usable(features1)
    got = soft(features0, features1, temperature=temperature)
    np.testing.assert_array_equal(got.mask, rows0 & rows1.any())
    assert ((got.confidence >= 0) & (got.confidence <= 1)).all()
    if rows1.any():
        expected = score_oracles.soft_matches(
            features0.descriptors[rows0],
            features1.descriptors[rows1],
            features1.keypoints[rows1],
            features1.scores[rows1],
            temperature,
        )
        columns = np.column_stack([got.points1, got.scores1, got.distance**2, got.confidence])[rows0]
        expected[:, 3] **= 2  # the root of a float32 near 0 has no digits left
        np.testing.assert_allclose(columns, expected, rtol=1e-4, atol=2e-6 + 2e-7 / temperature)
        np.testing.assert_array_equal(got.points0, features0.keypoints)


@pytest.mark.parametrize("seed", range(3))
def test_soft_becomes_hard(seed):
    rng = np.random.default_rng(seed)
    pair = make_features(rng, 25, capacity=28), make_features(rng, 30, capacity=32)
    with jax.enable_x64(True):
        pair = double(pair)
        hard = {mode: with_ratio(*pair, cross_check=mode) for mode in ("mutual", "none")}
        cool = [soft(*pair, temperature=t) for t in (1.0, 0.1, 1e-2, 1e-3, 1e-7)]
        mutual = hard["mutual"].mask.astype(float)
        real, errors = hard["none"].mask, []
        for smooth in cool:
            gaps = [
                jnp.max(jnp.abs(getattr(smooth, name) - getattr(hard["none"], name))[real])
                for name in ("points1", "distance", "scores1")
            ]
            errors.append([float(jnp.mean(jnp.abs(smooth.confidence - mutual)[real])), *map(float, gaps)])
    errors = np.array(errors)
    np.testing.assert_array_equal(cool[0].mask, real)
    assert (np.diff(errors[:, 0]) < 0).all()
    assert (np.diff(errors[1:], axis=0) <= 0).all()
    np.testing.assert_allclose(errors[-1], 0, atol=1e-6)


def test_order_and_batch_do_not_matter():
    rng = np.random.default_rng(3)
    query = make_features(rng, 15, capacity=18)
    candidates = [make_features(rng, count, capacity=20) for count in (20, 0, 1, 11)]
    got = jax.jit(jax.vmap(partial(soft_match, temperature=0.1), in_axes=(None, 0)))(query, stack(candidates))
    order0, order1 = rng.permutation(18), rng.permutation(20)
    for row, candidate in enumerate(candidates):
        alone = soft(query, candidate, temperature=0.1)
        mixed = soft(shuffled(query, order0), shuffled(candidate, order1), temperature=0.1)
        for name in ("points1", "distance", "scores1", "confidence", "mask"):
            np.testing.assert_allclose(getattr(got, name)[row], getattr(alone, name), rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(getattr(mixed, name), getattr(alone, name)[order0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["empty query", "empty candidate", "identical", "one"])
def test_degenerate_images_have_finite_gradients(kind):
    rng = np.random.default_rng(5)
    features0 = make_features(rng, {"empty query": 0, "one": 1}.get(kind, 6), capacity=8)
    features1 = make_features(rng, {"empty candidate": 0, "one": 1}.get(kind, 6), capacity=8)
    if kind in ("identical", "one"):
        features1.descriptors[features1.mask] = features0.descriptors[features0.mask] = np.eye(16)[3]

    def total(temperature, descriptors0, descriptors1, keypoints1, scores1):
        image0 = replace(features0, descriptors=descriptors0)
        image1 = replace(features1, descriptors=descriptors1, keypoints=keypoints1, scores=scores1)
        smooth = soft_match(image0, image1, temperature=temperature)
        terms = smooth.confidence * smooth.distance + smooth.scores1 + smooth.points1[:, 0]
        return jnp.sum(jnp.where(smooth.mask, terms, 0.0))

    inputs = features0.descriptors, features1.descriptors, features1.keypoints, features1.scores
    gradients = jax.jit(jax.grad(total, argnums=range(5)))
    for temperature in (1e-6, 0.1):
        assert all(np.isfinite(gradient).all() for gradient in gradients(temperature, *inputs))


@given(feature_pairs(), st.sampled_from(["mutual", "opencv_legacy", "none"]))
def test_ratios_agree_with_the_loop(pair, mode):
    features0, features1 = pair
    rows0 = usable(features0)
    got = with_ratio(features0, features1, cross_check=mode)
    assert np.isfinite(got.ratio).all()
    expected = score_oracles.ratios(features0.descriptors[rows0], features1.descriptors[usable(features1)])
    np.testing.assert_allclose(got.ratio[rows0], expected, atol=1e-5)
    assert ((got.ratio >= 0) & (got.ratio <= 1)).all()


def test_an_exact_copy_has_ratio_zero_and_two_copies_have_one():
    features = make_features(np.random.default_rng(8), 5)
    np.testing.assert_array_equal(with_ratio(features, features).ratio, 0)
    assert match(features, features).ratio is None
    features.descriptors[:] = features.descriptors[0]
    np.testing.assert_array_equal(with_ratio(features, features).ratio, 1)
