"""The image size of a pipeline that leaves it to the images."""

import shutil

import numpy as np
import pytest
from PIL import Image

import mfvpr
from mfvpr import InputError
from mfvpr.datasets import image_folder
from mfvpr.evaluation import match_sequence
from mfvpr.evaluation.system import folders_of
from mfvpr.features import Aggregated, Sift, VladFitting
from mfvpr.retrieval import Retrieval
from mfvpr.utils.fingerprints import recipe_of

PIXELS, SIZE = 160 * 120, (160, 120)


def system_of(sift, **options):
    retrieval = Retrieval(Aggregated(sift, VladFitting(num_words=8)))
    pipeline = mfvpr.Pipeline(sift, retrieval, candidates=5, **options)
    return mfvpr.System(pipeline, {"histogram": mfvpr.HistogramOfShifts()})


AUTO = system_of(Sift(max_keypoints=60), pixels=PIXELS)
FIXED = system_of(Sift(max_keypoints=60, image_size=SIZE))


def test_the_first_image_decides_for_all_stages(dataset):
    lines = []
    fitted = AUTO.fit_image_size(folders_of(dataset), lines.append)
    assert recipe_of(fitted.pipeline) == recipe_of(FIXED.pipeline)
    assert FIXED.fit_image_size(folders_of(dataset), lines.append) is FIXED
    assert not lines


def test_an_evaluation_is_that_of_the_size(dataset):
    auto, fixed = (mfvpr.evaluate(dataset, system).only for system in (AUTO, FIXED))
    assert auto.system.pipeline.extractor.image_size == SIZE
    np.testing.assert_array_equal(auto.systems["histogram"][0].rows, fixed.systems["histogram"][0].rows)
    matched = match_sequence(dataset, dataset.only, AUTO.pipeline)
    np.testing.assert_array_equal(matched.matches[0].image_sizes, fixed.matched[0].matches[0].image_sizes)


def test_images_of_another_shape_are_named_once(small_street, tmp_path):
    shutil.copytree(small_street / "database", tmp_path / "mixed")
    (tmp_path / "mixed/0000.png").write_bytes(b"no image")  # which decides nothing
    Image.new("RGB", (50, 90)).save(tmp_path / "mixed/0004.png")
    Image.new("RGB", (1001, 750)).save(tmp_path / "mixed/0005.png")  # the same but for rounding
    lines, folder = [], image_folder(tmp_path / "mixed")
    fitted = AUTO.fit_image_size([folder, folder], lines.append)
    assert fitted.pipeline.extractor.image_size == SIZE
    [line] = lines
    assert "160 x 120 px, but 1 of 9 have another aspect ratio" in line
    assert "mixed/0004.png" in line


def test_no_image_has_no_shape(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="expected images to take the shape from"):
        AUTO.fit_image_size([image_folder(tmp_path)], print)
