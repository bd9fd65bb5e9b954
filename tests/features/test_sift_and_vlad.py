"""RootSIFT and VLAD."""

import cv2
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import InputError
from mfvpr.features import FeatureSet, Sift, Vlad, VladFitting
from tests import oracles
from tests.builders import make_features, unit


@pytest.fixture
def image():
    noise = np.random.default_rng(0).integers(0, 256, (42, 42, 3), dtype=np.uint8)
    return cv2.resize(noise, (336, 336), interpolation=cv2.INTER_CUBIC)


def test_rootsift_is_opencvs_sift_with_the_square_root(image):
    features = Sift(max_keypoints=200)(image[None])[0].features
    keypoints, descriptors = cv2.SIFT_create(200).detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    by_place = {tuple(k.pt): (d, k.response) for k, d in zip(keypoints, descriptors, strict=True)}
    assert 100 < len(features.mask) <= 200
    assert features.mask.all()
    np.testing.assert_array_equal(features.image_size, [336, 336])
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, rtol=1e-5)
    assert (np.diff(features.scores) <= 0).all()
    places = [tuple(map(float, point)) for point in features.keypoints]
    unique = [k for k, place in enumerate(places) if places.count(place) == 1]
    assert len(unique) > 50
    for k in unique:
        descriptor, response = by_place[places[k]]
        np.testing.assert_allclose(features.descriptors[k] ** 2, descriptor / descriptor.sum(), rtol=1e-4, atol=1e-7)
        assert features.scores[k] == np.float32(response)


def test_an_image_without_keypoints_gives_empty_features():
    features = Sift()(np.full((1, 336, 336, 3), 128, np.uint8))[0].features
    assert [leaf.shape for leaf in jax.tree.leaves(features)] == [(0, 2), (0, 128), (0,), (0,), (2,)]


@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from([0, 1, 7, 40]), max_size=4), st.sampled_from([0.5, 1.0]))
def test_vlad_agrees_with_the_oracle(seed, counts, power):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(5, 16)).astype(np.float32)
    images = [make_features(rng, count, capacity=44) for count in (*counts, 7)]
    got = Vlad(centers, power)(images)
    expected = [oracles.vlad(features.descriptors[features.mask], centers, power) for features in images]
    np.testing.assert_allclose(got, expected, atol=2e-5)
    assert got.dtype == np.float32


def test_vocabulary_is_reproducible_and_finds_clusters():
    rng = np.random.default_rng(1)
    true = unit(rng.normal(size=(4, 16)))
    members = unit(np.repeat(true, 50, axis=0) + 0.01 * rng.normal(size=(200, 16)))
    features = make_features(rng, 200)
    features.descriptors[:] = members
    first, second = (VladFitting(num_words=4, seed=0).fit(FeatureSet.of([features])) for _ in range(2))
    np.testing.assert_array_equal(first.centers, second.centers)
    is_near = np.linalg.norm(first.centers[:, None] - true, axis=-1).min(axis=0) < 0.05
    assert is_near.sum() >= 2  # a start at random may put two words into one cluster


def test_last_bits_and_one_keypoint_less_hardly_move_the_words():
    """Descriptors anywhere on the sphere, where k-means is as unstable as it can be."""
    rng = np.random.default_rng(2)
    images, fitting = [make_features(rng, 60) for _ in range(40)], VladFitting(num_words=12, seed=3)
    before = fitting.fit(FeatureSet.of(images)).centers
    assert np.linalg.norm(before[:, None] - before, axis=-1)[np.triu_indices(12, 1)].min() > 0.02
    for features in images:
        features.descriptors[:] = np.nextafter(features.descriptors, rng.choice([-2, 2], features.descriptors.shape))
    np.testing.assert_allclose(fitting.fit(FeatureSet.of(images)).centers, before, atol=1e-5)
    images[7].mask[5] = False
    np.testing.assert_allclose(fitting.fit(FeatureSet.of(images)).centers, before, atol=0.02)


def test_a_vocabulary_of_some_images_knows_no_others():
    rng = np.random.default_rng(3)
    images = [make_features(rng, 20) for _ in range(5)]
    before = VladFitting(num_words=4, max_samples=30).fit(FeatureSet.of(images)).centers
    unseen = 0
    for features in images:
        original = features.descriptors.copy()
        features.descriptors[:] = original[0]
        unseen += np.array_equal(VladFitting(num_words=4, max_samples=30).fit(FeatureSet.of(images)).centers, before)
        features.descriptors[:] = original
    assert unseen == 3


def test_identical_features_and_single_ones_have_words():
    alike = make_features(np.random.default_rng(4), 9)
    alike.descriptors[:] = alike.descriptors[0]
    for images in ([alike], [make_features(np.random.default_rng(5), 1)] * 9):
        words = VladFitting(num_words=9).fit(FeatureSet.of(images)).centers
        np.testing.assert_allclose(np.linalg.norm(words, axis=1), 1, atol=1e-3)


def test_fewer_features_or_samples_than_words_are_the_users_to_mend():
    with pytest.raises(InputError, match=r"num_words=64 words, got 10 in 1 database images"):
        VladFitting().fit(FeatureSet.of([make_features(np.random.default_rng(2), 10)]))
    with pytest.raises(InputError, match=r"^max_samples=10: .*num_words=64\b"):
        VladFitting(max_samples=10)
