"""The cache of features extracts every image once, and again when the image or the extractor changed."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mfvpr import Runtime
from mfvpr.datasets import image_folder
from mfvpr.datasets.image_reading import resize
from mfvpr.features import Aggregated, Description, VladFitting
from mfvpr.storage import FeatureCache, feature_cache
from mfvpr.storage.feature_cache import Recipes
from mfvpr.utils import InputError, recipe_of
from tests.storage.extractors import SIFT, Counted, Mean, TwoScales
from tests.storage.synthetic_features import DAMAGE, assert_same

pytestmark = pytest.mark.thorough
ON_DISK = pytest.mark.parametrize("on_disk", [True, False])


@pytest.fixture(scope="module")
def folder(small_street):
    return image_folder(small_street / "database")


def all_of(features):
    return [features[row] for row in range(len(features))]


def assert_same_features(got, expected):
    for features, other in zip(all_of(got), all_of(expected), strict=True):
        assert_same(features, other)


def test_what_was_extracted_is_read_ever_after(folder, tmp_path):
    [plain] = FeatureCache().local(folder, SIFT)
    extractor, feature_sets = Counted(), []
    for _ in range(2):
        [features] = FeatureCache(tmp_path).local(folder, extractor)
        feature_sets.append(features)
    assert extractor.seen == len(folder)
    assert_same_features(*feature_sets)
    for first, exact in zip(all_of(feature_sets[0]), all_of(plain), strict=True):
        for name in ("keypoints", "descriptors", "scores", "mask", "image_size"):
            tolerance = 2e-4 if name == "descriptors" else 0
            np.testing.assert_allclose(getattr(first, name), getattr(exact, name), atol=tolerance)


@ON_DISK
def test_only_what_is_asked_for_is_extracted_and_nothing_twice(folder, tmp_path, on_disk):
    extractor, cache = Counted(), FeatureCache(tmp_path if on_disk else None)
    for rows, seen in (([7, 2], 2), ([2], 2), ([2, 3, 7], 3), ([], 3)):
        [features] = cache.local(folder, extractor, rows)
        assert extractor.seen == seen
        assert len(features) == len(folder)
    assert sorted(np.flatnonzero(features.counts).tolist()) == [2, 3, 7]
    [all_features] = cache.local(folder, extractor)
    assert extractor.seen == len(folder)
    assert_same_features(all_features, FeatureCache(tmp_path if on_disk else None).local(folder, SIFT)[0])


@ON_DISK
def test_an_extractor_that_was_changed_is_another_one(folder, tmp_path, on_disk):
    extractor, cache = Counted(), FeatureCache(tmp_path if on_disk else None)
    for number in (5, 9, 5):
        extractor.extractor = replace(SIFT, max_keypoints=number)
        extractor.recipe = recipe_of(extractor.extractor)
        [features] = cache.local(folder, extractor)
        assert features.counts.max() == number


@ON_DISK
def test_images_are_known_by_their_content(folder, tmp_path, on_disk):
    """Take parts of a folder, other names, and an image that is there twice."""
    extractor, cache = Counted(), FeatureCache(tmp_path / "s" if on_disk else None)
    [features] = cache.local(folder, extractor)
    [part] = cache.local(replace(folder, names=folder.names[7:2:-2]), extractor)
    assert_same_features(part, [features[row] for row in (7, 5, 3)])
    if on_disk:
        root = tmp_path / "images"
        shutil.copytree(folder.root, root)
        shutil.copy(root / "0003.png", root / "again.png")
        [copied] = cache.local(image_folder(root), extractor)
        assert_same_features(copied, [*all_of(features), features[3]])
    assert extractor.seen == len(folder)


@pytest.mark.parametrize("change", [{"bits": 12}, {"orient": False}])
def test_other_conversions_give_other_images(tmp_path, change):
    Image.fromarray(np.full((120, 160), 4095, np.uint16)).save(tmp_path / "deep.png")
    cache, folder = FeatureCache(tmp_path / "s"), image_folder(tmp_path)
    before, after = (cache.recipes.contents(images).keys for images in (folder, replace(folder, **change)))
    assert before != after
    assert feature_cache.states(folder) != feature_cache.states(replace(folder, **change))  # by which memory knows it


def test_what_another_version_decodes_are_other_images(monkeypatch):
    known, recipe = feature_cache.versions(), Recipes(None).of_features(SIFT)
    for name in ("opencv-python-headless", "pillow"):
        monkeypatch.setattr(feature_cache, "versions", lambda name=name: {**known, name: "0"})
        assert Recipes(None).of_features(SIFT) != recipe
    monkeypatch.setattr(feature_cache, "versions", lambda: {**known, "mfvpr": "0"})  # a release decodes as the last one
    assert Recipes(None).of_features(SIFT) == recipe
    monkeypatch.setattr(feature_cache, "DECODING", "0")
    assert Recipes(None).of_features(SIFT) != recipe


@ON_DISK
def test_files_that_were_changed_are_looked_at_again(tmp_path, on_disk, small_street):
    root = tmp_path / "images"
    shutil.copytree(small_street / "database", root)
    cache, folder = FeatureCache(tmp_path / "s" if on_disk else None), image_folder(root)
    [before] = cache.local(folder, SIFT, [0, 1])
    before = before[1]
    for row in range(len(folder)):
        shutil.copy(small_street / "queries" / f"{9 - row:04d}.png", root / f"{row:04d}.png")
    [after] = cache.local(folder, SIFT)
    [expected] = FeatureCache(tmp_path / "other" if on_disk else None).local(folder, SIFT)
    assert_same_features(after, expected)
    assert not np.array_equal(before.keypoints, after[1].keypoints)


def test_one_pass_gives_a_vector_and_several_scales(folder, tmp_path):
    images = np.stack([resize(folder.read(row), SIFT.image_size, SIFT.interpolation) for row in range(len(folder))])
    for root, seen in ((None, len(folder)), (tmp_path, len(folder)), (tmp_path, 0)):
        extractor, cache = Counted(TwoScales()), FeatureCache(root)
        vectors = cache.vectors(folder, extractor, folder)
        np.testing.assert_array_equal(vectors.values, [mean.vector for mean in Mean()(images)])
        first, second = cache.local(folder, extractor, [1, 4])
        assert (second.counts == -(-first.counts // 2)).all()
        np.testing.assert_array_equal(second[4].keypoints, first[4].keypoints[::2])
        assert extractor.seen == seen


def test_an_interrupted_extraction_goes_on_where_it_was(folder, tmp_path):
    interrupted, resumed = Counted(limit=7), Counted()
    with pytest.raises(KeyboardInterrupt):
        FeatureCache(tmp_path).local(folder, interrupted)
    [features] = FeatureCache(tmp_path).local(folder, resumed)
    assert interrupted.seen == 6
    assert resumed.seen == len(folder) - 6
    [expected] = FeatureCache(tmp_path / "uninterrupted").local(folder, SIFT)
    assert_same_features(features, expected)


def test_bad_images_fail_by_default_with_the_mend(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.png: cannot be read .*, or set on_bad_image=skip"):
        FeatureCache().local(image_folder(tmp_path), SIFT)
    with pytest.raises(InputError, match=r"none of 1 images .*a\.png"):
        FeatureCache(skip_bad=True).local(image_folder(tmp_path), SIFT)


@pytest.fixture
def colors(tmp_path):
    """Three plain images and one that cannot be read."""
    root = tmp_path / "images"
    root.mkdir()
    for name, color in (("a", (200, 10, 10)), ("b", (0, 0, 0)), ("d", (10, 10, 200))):
        Image.new("RGB", (30, 20), color).save(root / f"{name}.png")
    (root / "c.png").write_bytes(b"")
    return image_folder(root)


class Dark(Mean):
    """Divides by the mean color, which is not finite where all is black."""

    recipe = "dark"

    def __call__(self, images):
        with np.errstate(divide="ignore"):
            return [Description(vector) for vector in (1 / images.mean((1, 2))).astype(np.float32)]


@ON_DISK
def test_global_descriptors_are_stored_as_well_and_images_without_one_are_listed(colors, tmp_path, on_disk):
    dark = Counted(Dark())
    for seen in (3, 4):  # the black image is tried again
        descriptors = FeatureCache(tmp_path / "s", skip_bad=True).vectors(colors, dark, colors)
        assert dark.seen == seen
    if not on_disk:
        descriptors = FeatureCache(skip_bad=True).vectors(colors, Dark(), colors)
    assert sorted(descriptors.bad) == [1, 2]
    assert "b.png: features are not finite" in descriptors.bad[1]
    assert np.isnan(descriptors.values).any(axis=1).tolist() == [False, True, True, False]


def test_aggregations_are_fitted_on_the_database(folder, small_street, tmp_path):
    queries, describer = image_folder(small_street / "queries"), Aggregated(SIFT, VladFitting(num_words=4))
    cache = FeatureCache(tmp_path)
    [local] = cache.local(folder, SIFT)
    vlad = VladFitting(num_words=4).fit(local)
    for images in (folder, queries):
        [features] = cache.local(images, SIFT)
        np.testing.assert_allclose(cache.vectors(images, describer, folder).values, vlad(all_of(features)), atol=1e-6)


def test_a_damaged_file_is_made_again_with_a_warning(folder, tmp_path):
    lines, extractor = [], Counted()
    [before] = FeatureCache(tmp_path).local(folder, extractor)
    [path] = (tmp_path / "Counted-0").parent.glob(f"Counted-*/*/{before.source.keys[3][2:]}.npz")
    DAMAGE["flipped"](path)
    [again] = FeatureCache(tmp_path, runtime=Runtime(log=lines.append)).local(folder, extractor)
    assert lines[0] == f"warning: {path}: is damaged; made again"
    assert extractor.seen == len(folder) + 1
    assert_same_features(again, before)


def test_what_has_no_recipe_is_kept_in_memory_alone_which_is_said_once(folder, tmp_path):
    extractor, lines = Counted(), []
    del extractor.recipe
    cache = FeatureCache(tmp_path, runtime=Runtime(log=lines.append))
    for _ in range(2):
        [features] = cache.local(folder, extractor)
    assert extractor.seen == len(folder)
    assert [line for line in lines if "warning" in line] == [
        "warning: Counted names no `recipe`: what it makes is not kept on disk"
    ]
    assert [path.name for path in tmp_path.iterdir()] in ([], ["contents"])
    assert_same(features[0], FeatureCache().local(folder, SIFT)[0][0])


def test_an_image_that_changes_while_it_is_described_is_refused(folder, tmp_path, monkeypatch):
    """Otherwise its features would be those of the content that it had before."""
    root = tmp_path / "images"
    shutil.copytree(folder.root, root)
    copied, plain = image_folder(root), feature_cache.describe_folder

    def describe(*arguments, **options):
        shutil.copy(root / "0001.png", root / "0005.png")
        yield from plain(*arguments, **options)

    monkeypatch.setattr(feature_cache, "describe_folder", describe)
    with pytest.raises(InputError, match=r"0005\.png: changed while it was described"):
        FeatureCache(tmp_path / "s").local(copied, SIFT)
    monkeypatch.undo()
    [features] = FeatureCache(tmp_path / "s").local(copied, SIFT)
    assert_same(features[5], features[1])
