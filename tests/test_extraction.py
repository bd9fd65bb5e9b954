"""Features of a folder through a store: extracted once, whatever happens in between."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mfvpr import match, pipeline
from mfvpr.data.datasets import image_folder
from mfvpr.errors import InputError
from mfvpr.features.sift import Sift
from mfvpr.stores.features import forecast_bytes, open_store
from mfvpr.types import Features
from tests.builders import make_features
from tests.stores.made_up import assert_same

SIFT = Sift(max_keypoints=60, batch_size=3)


class Counted:
    """SIFT that counts its images, and is killed after some."""

    image_size, interpolation, batch_size = SIFT.image_size, SIFT.interpolation, SIFT.batch_size
    dimension, typical_count = SIFT.dimension, SIFT.typical_count

    def __init__(self, limit=100):
        self.seen, self.limit = 0, limit

    def __call__(self, images):
        if self.seen + len(images) > self.limit:
            raise KeyboardInterrupt
        self.seen += len(images)
        return SIFT(images)


class Mean:
    """A global descriptor: the mean color, of unit length."""

    image_size, interpolation, batch_size, dimension, typical_count = (16, 16), "pil_bilinear", 4, 3, 1

    def __init__(self):
        self.seen = 0

    def __call__(self, images, features):
        self.seen += len(images)
        mean = images.mean((1, 2)).astype(np.float32) + 1
        return mean / np.linalg.norm(mean, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def folder(small_street):
    return image_folder(small_street / "database")


@pytest.fixture
def opened(tmp_path):
    @contextmanager
    def opened(folder, name="store"):
        with open_store(tmp_path / name, {"name": name}, num_images=len(folder)) as store:
            yield store

    return opened


def test_a_store_gives_what_was_extracted_and_is_read_ever_after(folder, opened):
    plain = pipeline.extract(folder, SIFT)
    extractor, found = Counted(), []
    for _ in range(2):
        with opened(folder) as store:
            found.append(pipeline.extract(folder, extractor, store=store))
    assert extractor.seen == len(folder)
    for row in range(len(folder)):
        first, again, exact = (one[row] for one in (*found, plain))
        assert_same(first, again)
        for name in ("keypoints", "descriptors", "scores", "mask", "image_size"):
            tolerance = 2e-4 if name == "descriptors" else 0
            np.testing.assert_allclose(getattr(first, name), getattr(exact, name), atol=tolerance)


def test_an_interrupted_extraction_goes_on_where_it_was(folder, opened):
    interrupted, resumed = Counted(limit=7), Counted()
    with pytest.raises(KeyboardInterrupt), opened(folder) as store:
        pipeline.extract(folder, interrupted, store=store)
    with opened(folder) as store:
        assert store.done.sum() == interrupted.seen == 6
        found = pipeline.extract(folder, resumed, store=store)
    assert resumed.seen == len(folder) - 6
    with opened(folder, "uninterrupted") as store:
        expected = pipeline.extract(folder, SIFT, store=store)
    for row in range(len(folder)):
        assert_same(found[row], expected[row])


def test_bad_images_are_tried_again(tmp_path, opened):
    for name in "abc":
        Image.effect_noise((64, 64), 80).convert("RGB").save(tmp_path / f"{name}.png")
    good = (tmp_path / "b.png").read_bytes()
    (tmp_path / "b.png").write_bytes(b"")
    folder = image_folder(tmp_path)
    with opened(folder) as store:
        assert list(pipeline.extract(folder, SIFT, store=store, skip_bad=True).bad) == [1]
    (tmp_path / "b.png").write_bytes(good)
    with opened(folder) as store:
        found = pipeline.extract(folder, SIFT, store=store, skip_bad=True)
    assert found.bad == {}
    assert found.counts.all()


def test_global_descriptors_are_stored_as_well(tmp_path, opened):
    for name, color in (("a", (200, 10, 10)), ("b", (10, 200, 10)), ("d", (10, 10, 200))):
        Image.new("RGB", (30, 20), color).save(tmp_path / f"{name}.png")
    (tmp_path / "c.png").write_bytes(b"")
    folder, mean = image_folder(tmp_path), Mean()
    features = pipeline.extract(folder, SIFT, skip_bad=True)
    plain = pipeline.describe(folder, features, mean, skip_bad=True)
    found = []
    for _ in range(2):
        with opened(folder) as store:
            found.append(pipeline.describe(folder, features, mean, store=store, skip_bad=True))
    assert mean.seen == 3 + 3
    np.testing.assert_array_equal(found[0].values, found[1].values)
    np.testing.assert_allclose(found[0].values, plain.values, atol=3e-4)
    assert np.isnan(plain.values[2]).all()
    np.testing.assert_allclose(np.linalg.norm(plain.values[[0, 1, 3]], axis=1), 1, rtol=1e-5)
    for one in (*found, plain):
        assert one.bad == features.bad
        assert list(one.bad) == [2]


class Dark(Mean):
    """Divides by the mean color, which is not finite where all is black."""

    def __call__(self, images, features):
        with np.errstate(divide="ignore"):
            return (1 / images.mean((1, 2))).astype(np.float32)


def test_images_without_a_global_descriptor_are_listed(tmp_path, opened):
    """Their local features may be fine."""
    for name, color in (("a", (200, 10, 10)), ("b", (0, 0, 0)), ("d", (10, 10, 200))):
        Image.new("RGB", (30, 20), color).save(tmp_path / f"{name}.png")
    (tmp_path / "c.png").write_bytes(b"")
    folder = image_folder(tmp_path)
    features = pipeline.extract(folder, SIFT, skip_bad=True)
    assert list(features.bad) == [2]
    with opened(folder) as store:
        for described in (
            pipeline.describe(folder, features, Dark(), skip_bad=True),
            pipeline.describe(folder, features, Dark(), store=store, skip_bad=True),
        ):
            assert sorted(described.bad) == [1, 2]
            assert "b.png: features are not finite" in described.bad[1]
            assert np.isnan(described.values).any(axis=1).tolist() == [False, True, True, False]


def test_global_descriptors_take_no_more_memory_than_they_are(folder):
    """One slot each, whatever local features are padded to."""
    features = pipeline.extract(folder, SIFT)
    values = pipeline.describe(folder, features, Mean()).values
    assert values.shape == (len(folder), 3)
    assert values.base is None or values.base.nbytes == values.nbytes


@pytest.mark.parametrize(("images", "features", "paper", "readme"), [(220, 686, 304, 153), (1415, 681, 1942, 978)])
def test_the_papers_databases_take_about_half(images, features, paper, readme):
    ours = (forecast_bytes(images, features, 512) + forecast_bytes(images, 1, 4096)) / 2**20
    assert ours <= 0.55 * paper
    assert round(ours) == readme


def test_a_forecast_is_not_exceeded(folder, opened):
    """Random descriptors, which compress worst."""
    rng = np.random.default_rng(0)
    with opened(folder) as store:
        for row in range(len(folder)):
            descriptors = rng.normal(size=(700, 512)).astype(np.float32)
            descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
            points, scores = rng.uniform(0, 336, (700, 2)).astype(np.float32), rng.uniform(size=700).astype(np.float32)
            size = np.full(2, 336, np.float32)
            store.write({row: Features(points, descriptors, scores, np.ones(700, bool), size)})
        forecast = forecast_bytes(len(folder), 700, 512)
        assert 0.8 * forecast < store.size_bytes <= forecast + 100_000  # folders and what describes the arrays
        assert store.size_bytes <= 0.55 * 2064 * 700 * len(folder)


def test_features_of_ones_own_are_matched_as_they_are():
    """As hloc keeps them: half precision, another number in every image; and padded ones."""
    rng = np.random.default_rng(0)
    images = [make_features(rng, count, capacity=40) for count in (7, 0, 40, 33)]
    images[2] = replace(images[2], descriptors=images[2].descriptors.astype(np.float16).astype(np.float32))
    found = pipeline.FeatureSet.of(images)
    assert len(found) == 4
    assert found.counts.tolist() == [7, 0, 40, 33]
    candidates = pipeline.shortlist(np.eye(4, dtype=np.float32), np.ones((4, 4), np.float32) / 2, 4)
    matches = pipeline.match(found, found, candidates)
    for query, row in ((0, 2), (2, 3), (3, 0), (1, 2)):
        alone = match(images[query], images[row])
        place = candidates.indices[query].tolist().index(row)
        assert matches.counts[query, place] == alone.mask.sum()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"descriptors": np.ones((16, 5), np.float32)}, r"image 0: expected keypoints .* transpose descriptors"),
        ({"mask": np.ones(5)}, r"mask \[N\] bool"),
        ({"descriptors": np.full((5, 16), 7.0, np.float32)}, "unit length, got 28; divide"),
    ],
)
def test_features_of_ones_own_that_do_not_fit_are_told(change, words):
    image = replace(make_features(np.random.default_rng(0), 5), **change)
    with pytest.raises(InputError, match=words):
        pipeline.FeatureSet.of([image])
    with pytest.raises(InputError, match="at least one image"):
        pipeline.FeatureSet.of([])


def test_descriptors_are_of_unit_length_only_where_that_is_asked():
    image = make_features(np.random.default_rng(0), 5)
    longer = replace(image, descriptors=3 * image.descriptors)
    found = pipeline.FeatureSet.of([longer], unit_length=False)
    np.testing.assert_array_equal(found[0].descriptors, longer.descriptors)
