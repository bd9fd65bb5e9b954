"""Masks: no extractor sees ignored pixels, and another mask gives other features."""

import numpy as np
import pytest
from PIL import Image

from mfvpr import Pipeline, datasets
from mfvpr.datasets import image_folder
from mfvpr.evaluation import match_sequence
from mfvpr.features import Aggregated, VladFitting
from mfvpr.features.extractor import BORDER
from mfvpr.retrieval import Retrieval
from mfvpr.retrieval.precomputed import FeatureFiles
from mfvpr.storage import FeatureCache
from tests.io.checks import one_line_error
from tests.storage.extractors import SIFT, TwoScales
from tests.storage.synthetic_features import assert_same

IGNORED = 70  # first row of the mask; the images are twice as large


@pytest.fixture
def root(tmp_path):
    """A mask, and two folders of images that differ in ignored pixels only."""
    rng = np.random.default_rng(0)
    used = rng.integers(0, 256, (2 * IGNORED, 320, 3), np.uint8)
    for name in ("database/0.png", "database/1.png", "queries/0.png", "queries/1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        below = rng.integers(0, 256, (240 - len(used), 320, 3), np.uint8)
        Image.fromarray(np.concatenate([np.roll(used, int(name[-5]), 0), below])).save(tmp_path / name)
    return write_mask(tmp_path / "mask.png").parent


def write_mask(path, first=IGNORED, value=255):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(np.where(np.arange(120) < first, value, 0).astype(np.uint8)[:, None], 160, 1)).save(path)
    return path


def test_no_descriptor_knows_ignored_pixels(root):
    folders, cache = (
        [image_folder(root / side, masks=root / "mask.png") for side in ("database", "queries")],
        FeatureCache(),
    )
    first, second = (cache.vectors(folder, TwoScales(), folder).values for folder in folders)
    np.testing.assert_array_equal(first, second)
    for features, same in zip(*(cache.local(folder, TwoScales()) for folder in folders), strict=True):
        assert_same(features[1], same[1])
        assert 0 < features[1].keypoints[:, 1].max() < IGNORED - BORDER
    image, ignored = folders[0].read_with_ignored(0)
    assert ignored.sum() == (240 - 2 * IGNORED) * 320
    assert (image[ignored] == np.rint(image[~ignored].mean(axis=0))[None]).all()


@pytest.mark.parametrize("on_disk", [True, False])
def test_another_mask_gives_other_features(root, on_disk):
    folder = image_folder(root / "database", masks=root / "mask.png")
    cache = FeatureCache(root / "cache" if on_disk else None)
    plain, before = cache.recipes.contents(image_folder(root / "database")), cache.recipes.contents(folder)
    [features] = cache.local(folder, SIFT)
    write_mask(root / "mask.png", 40)
    after, [others] = cache.recipes.contents(folder), cache.local(folder, SIFT)
    assert len({before.fingerprint, after.fingerprint, plain.fingerprint}) == 3
    assert len({*before.keys, *after.keys, *plain.keys}) == 6
    assert others[0].keypoints[:, 1].max() < 40 < features[0].keypoints[:, 1].max()


def test_masks_by_name(root):
    for name in ("database/0.bmp", "database/1.png.png", "0.png", "1.TIF"):  # a subfolder for one side
        write_mask(root / "masks" / name)
    data = datasets.folder(root / "database", root / "queries", ground_truth="order", masks=root / "masks")
    assert (*data.database.mask_files.names, *data.queries.mask_files.names) == ("0.bmp", "1.png.png", "0.png", "1.TIF")
    (root / "masks" / "1.TIF").unlink()
    with one_line_error(r"masks: expected masks .* of all 2 images, got 1; the first without is 1\.png"):
        image_folder(root / "queries", masks=root / "masks")
    with one_line_error("nowhere: expected a folder of images, got nothing"):
        image_folder(root / "queries", masks=root / "nowhere")


def test_masks_that_cannot_be_used(root):
    data = datasets.folder(root / "database", root / "queries", ground_truth="order", masks=root / "mask.png")
    files = FeatureFiles({})
    with one_line_error(r"mask\.png: expected an extractor .*, got FeatureFiles"):
        match_sequence(data, data.only, Pipeline(files, Retrieval(Aggregated(files, VladFitting()))))
    write_mask(root / "mask.png", value=1)
    with one_line_error(r"mask\.png: expected .* 128 or more, .* ignores the whole image"):
        data.database.read(0)
    (root / "mask.png").write_bytes(b"no image")
    with one_line_error(r"mask\.png: cannot be read"):
        data.database.read(0)
