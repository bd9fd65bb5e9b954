"""The feature store: bits that come back, and their size. Refusals of all stores: test_rows.py."""

from dataclasses import fields

import numpy as np
import pytest

from mfvpr import Features
from mfvpr.storage.features import forecast_bytes, open_store
from tests.builders import make_features
from tests.storage.synthetic_features import RECIPE, assert_same, features_of, read_all


@pytest.mark.parametrize("count", [0, 1, 40, 1024, 2500])
def test_all_but_the_descriptors_is_exact(tmp_path, count):
    original = features_of(7, count)
    with open_store(tmp_path / "s", RECIPE, num_images=3) as store:
        store.write({1: original})
        assert store.counts.tolist() == [-1, count, -1]
        [(row, first)] = store.read()
    [(later_row, features)] = read_all(tmp_path / "s").items()
    assert row == later_row == 1
    assert_same(first, features)
    for name in ("keypoints", "scores", "mask", "image_size"):
        np.testing.assert_array_equal(getattr(features, name), getattr(original, name))
    assert {getattr(features, part.name).dtype.name for part in fields(Features)} == {"float32", "bool"}
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=2e-7)
    assert np.linalg.norm(features.descriptors - original.descriptors, axis=1).max(initial=0) < 5e-4


def test_descriptors_keep_their_length(tmp_path):
    """A projected descriptor need not be of unit length; float16 alone would lose or overflow the last of these."""
    lengths = np.array([1, 6.3, 0.1, 1e-9, 70000, 1e12], np.float32)
    original = features_of(0, len(lengths))
    original.descriptors[:] *= lengths[:, None]
    with open_store(tmp_path / "s", RECIPE, num_images=1) as store:
        store.write({0: original})
        [(_, features)] = store.read()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), lengths, rtol=3e-7)
    assert (np.linalg.norm(features.descriptors - original.descriptors, axis=1) < 5e-4 * lengths).all()


def test_zero_descriptors_stay_zero_and_padding_is_left_out(tmp_path):
    padded = make_features(np.random.default_rng(0), 5, capacity=9)
    padded.descriptors[2] = 0
    padded.scores[:5] = 0
    with open_store(tmp_path / "s", RECIPE, num_images=1) as store:
        store.write({0: padded})
        [(_, features)] = store.read()
    assert features.mask.shape == (5,)
    np.testing.assert_array_equal(features.descriptors[2], 0)
    np.testing.assert_array_equal(features.scores, 0)


def test_size_on_disk(tmp_path):
    counts = [650, 700, 750, 700, 690]
    with open_store(tmp_path / "s", RECIPE, num_images=1000) as store:
        store.write({row: features_of(row, count, 512) for row, count in enumerate(counts)})
        size = store.size_bytes
    apparent = sum(path.stat().st_size for path in (tmp_path / "s").rglob("*") if path.is_file())
    assert apparent <= size < 0.52 * 2064 * sum(counts)
    forecast = forecast_bytes(len(counts), np.mean(counts), 512)
    assert 0.83 * forecast < size <= forecast + 100_000  # random descriptors compress worst
