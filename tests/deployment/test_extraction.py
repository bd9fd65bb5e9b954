"""The exported extraction of XFeat gives the keypoints of the extractor."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.checkpoints import entry_of, is_installed, load_model
from mfvpr.features import XFeatFeatures
from tests.golden.make_d2net import texture
from tests.needs import needs
from tests.networks.checkpoints import fill_published
from tests.random_checkpoints import random_checkpoint, xfeat_shapes

pytestmark = pytest.mark.thorough

SIZE = (96, 64)
SHAPES = ExportShapes(candidates=1, keypoints=100, image_size=SIZE)


@pytest.fixture(scope="module", params=["random", pytest.param("real", marks=pytest.mark.slow)])
def extractor(request):
    """With random weights and a threshold that fits them, or with the public ones."""
    if request.param == "random":
        return XFeatFeatures(fill_published("xfeat", random_checkpoint(xfeat_shapes())), SIZE, threshold=0.03)
    if not is_installed(entry_of("xfeat")):
        pytest.skip("needs weights: mfvpr weights download xfeat")
    return XFeatFeatures(load_model("xfeat"), SIZE)


def test_a_reloaded_extraction_gives_the_features_of_the_extractor(extractor, tmp_path):
    program = mfvpr.export(tmp_path / "xfeat", extractor, SHAPES, onnx=False)  # reads the folder
    assert [(each.name, each.shape, each.dtype, each.unit) for each in (*program.inputs, *program.outputs)] == [
        ("image", (64, 96, 3), "uint8", ""),
        ("keypoints", (100, 2), "float32", "px"),
        ("descriptors", (100, 64), "float32", ""),
        ("scores", (100,), "float32", ""),
        ("mask", (100,), "bool", ""),
    ]
    plain, full = np.full((64, 96, 3), 128, np.uint8), texture(*SIZE)
    images = np.stack([full, np.concatenate([full[:32], plain[32:]])])
    for image, description in zip(images, extractor(images), strict=True):
        (features,) = description.local
        outputs = program(image=image)
        count = min(len(features.scores), 100)
        assert outputs["mask"].tolist() == [True] * count + [False] * (100 - count)
        for name in ("keypoints", "descriptors", "scores"):
            np.testing.assert_allclose(outputs[name][:count], getattr(features, name)[:count], atol=1e-6)
            assert not outputs[name][count:].any()


@needs("jax2onnx")
def test_onnx_runtime_gives_the_same_keypoints(extractor, tmp_path):
    program = mfvpr.export(tmp_path / "xfeat", extractor, SHAPES, onnx=True)
    assert program.description["onnx"]["largest_difference"] < 1e-5
    assert np.load(tmp_path / "xfeat" / "check" / "mask.npy").sum() > 5


@pytest.mark.parametrize(
    ("shapes", "options", "message"),
    [
        ({"image_size": (64, 96)}, {}, r"image_size=\[64, 96\]: expected that of the extractor, \[96, 64\]"),
        ({"keypoints": 2000}, {}, "keypoints=2000: expected at most 1000, the extractor's max_keypoints"),
        ({}, {"with_shift": True}, "with_shift, with_confidence: expected a scorer or a system, got an extractor"),
    ],
)
def test_extractions_that_cannot_be_exported_are_refused(extractor, tmp_path, shapes, options, message):
    with pytest.raises(InputError, match=message):
        mfvpr.export(tmp_path / "xfeat", extractor, replace(SHAPES, **shapes), **options)
