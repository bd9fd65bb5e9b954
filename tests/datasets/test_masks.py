"""Masks: no extractor sees ignored pixels, and another mask gives other features."""

import numpy as np
import pytest
from PIL import Image

from mfvpr import datasets
from mfvpr.evaluation import Pipeline, match_sequence
from mfvpr.retrieval.precomputed import DescriptorFiles, FeatureFiles
from mfvpr.storage import FeatureCache
from tests.io.checks import one_line_error
from tests.storage.extractors import SIFT, TwoScales
from tests.storage.synthetic_features import assert_same


@pytest.fixture
def root(tmp_path):
    """Images that differ below row 60 alone, where a mask ignores them."""
    for number, name in enumerate(("database/0.png", "database/1.png", "queries/0.png", "queries/1.png")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        pixels = [np.random.default_rng(seed).integers(0, 256, (60, 160, 3), np.uint8) for seed in (9, number)]
        Image.fromarray(np.concatenate(pixels)).save(tmp_path / name)
    return write_mask(tmp_path / "mask.png").parent


def write_mask(path, first=30):  # half as large as the images, black from this row on
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(np.uint8(255) * (np.arange(60) < first)[:, None], 80, axis=1)).save(path)
    return path


def test_no_descriptor_knows_ignored_pixels(root):
    folders = [datasets.image_folder(root / side, masks=root / "mask.png") for side in ("database", "queries")]
    np.testing.assert_array_equal(*(FeatureCache().vectors(each, TwoScales(), each).values for each in folders))
    for features, same in zip(*(FeatureCache().local(each, TwoScales()) for each in folders), strict=True):
        assert_same(features[1], same[1])
        assert 0 < features[1].keypoints[:, 1].max() < 60 - 4
    assert (folders[0].read(0)[60:] == np.rint(folders[1].read(0)[:60].mean(axis=(0, 1)))[None, None]).all()


@pytest.mark.parametrize("on_disk", [True, False])
def test_another_mask_gives_other_features(root, on_disk):
    folder = datasets.image_folder(root / "database", masks=root / "mask.png")
    cache, prints, lowest = FeatureCache(root / "cache" if on_disk else None), set(), []
    for first in (30, 20):
        write_mask(root / "mask.png", first)
        prints |= {cache.recipes.contents(folder).fingerprint, *cache.recipes.contents(folder).keys}
        lowest.append(cache.local(folder, SIFT)[0][0].keypoints[:, 1].max())
    assert len(prints) == 6
    assert lowest[1] < 40 < lowest[0]


@pytest.mark.parametrize("orient", [True, False])
def test_a_mask_with_the_orientation_of_its_photograph_is_turned_with_it(tmp_path, orient):
    turned = Image.Exif()
    turned[0x0112] = 6
    for folder, pixels in (
        ("images", np.full((120, 160), 99)),
        ("masks", 255 * (np.arange(120) < 60)[:, None].repeat(160, 1)),
    ):
        (tmp_path / folder).mkdir()
        Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / folder / "0.jpg", exif=turned)
    images = datasets.image_folder(tmp_path / "images", orient=orient, masks=tmp_path / "masks")
    image, ignored = images.read_with_ignored(0)
    assert image.shape[:2] == ignored.shape == ((160, 120) if orient else (120, 160))
    part = ignored[:, :50] if orient else ignored[70:]
    assert part.all()
    assert ignored.mean() == pytest.approx(0.5, abs=0.01)


def test_masks_of_images(root):
    for name in ("database/0.bmp", "database/1.png.png", "0.png"):  # a subfolder for one side
        write_mask(root / "masks" / name)
    folder = datasets.image_folder(root / "database", masks=root / "masks")
    assert folder.mask_files.names == ("0.bmp", "1.png.png")
    with one_line_error(r"masks: expected masks .* of all 2 images, got 1; the first without is 1\.png"):
        datasets.folder(root / "database", root / "queries", ground_truth="order", masks=root / "masks")
    write_mask(root / "masks" / "database" / "0.bmp", 0)
    with one_line_error(r"0\.bmp: expected .* 128 or more, .* ignores the whole image"):
        folder.read(0)
    Image.fromarray(np.full((80, 60), 255, np.uint8)).save(root / "turned.png")
    with one_line_error(r"turned\.png: expected a mask in the shape of its image, 160 x 120, got 60 x 80; scale"):
        datasets.image_folder(root / "database", masks=root / "turned.png").read(0)
    data = datasets.folder(root / "database", root / "queries", ground_truth="order", masks=root / "mask.png")
    with one_line_error(r"mask\.png: expected an extractor .*, got FeatureFiles"):
        match_sequence(data, data.only, Pipeline(FeatureFiles({}), DescriptorFiles({})))
