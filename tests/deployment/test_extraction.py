"""The exported extraction of XFeat gives the keypoints of the extractor."""

from dataclasses import replace

import numpy as np
import pytest

import mfvpr
from mfvpr import ExportShapes, InputError
from mfvpr.checkpoints import load_model
from mfvpr.features import XFeatFeatures
from tests.builders import local
from tests.golden.make_d2net import texture
from tests.needs import needs, use_weights
from tests.networks.checkpoints import fill_published
from tests.random_checkpoints import random_checkpoint, xfeat_shapes

pytestmark = pytest.mark.thorough
SIZE, SHAPES = (96, 64), ExportShapes(candidates=1, keypoints=100, image_size=(96, 64))


@pytest.fixture(scope="module", params=["random", pytest.param("real", marks=pytest.mark.slow)])
def extractor(request):
    if request.param == "random":  # with a threshold that fits the weights
        return XFeatFeatures(fill_published("xfeat", random_checkpoint(xfeat_shapes())), SIZE, threshold=0.03)
    with pytest.MonkeyPatch.context() as patch:
        use_weights("xfeat", patch)
        return XFeatFeatures(load_model("xfeat"), SIZE)


def test_a_program_gives_the_features_of_the_extractor_and_zeros(extractor, tmp_path):
    program = mfvpr.export(tmp_path / "xfeat", extractor, SHAPES, onnx=False)
    shapes = {each.name: (*each.shape, each.dtype) for each in (*program.inputs, *program.outputs)}
    vectors = {"keypoints": (100, 2, "float32"), "descriptors": (100, 64, "float32"), "scores": (100, "float32")}
    assert shapes == {"image": (64, 96, 3, "uint8"), **vectors, "mask": (100, "bool")}
    plain = np.pad(texture(16, 16), ((0, 48), (0, 80), (0, 0)), constant_values=128)
    counts = []
    for image in (texture(*SIZE), plain):
        outputs, [features] = program(image=image), local(extractor(image[None]))
        counts.append(min(len(features.scores), 100))
        assert outputs["mask"].tolist() == [row < counts[-1] for row in range(100)]
        for name in vectors:  # two compilations of one network: equal but for the last bits
            np.testing.assert_allclose(outputs[name][: counts[-1]], getattr(features, name)[:100], atol=1e-6)
            assert not outputs[name][counts[-1] :].any()
    assert counts[0] == 100 > counts[1] > 3


@needs("jax2onnx")
def test_onnx_runtime_gives_the_same_keypoints(extractor, tmp_path):
    mfvpr.export(tmp_path / "xfeat", extractor, SHAPES, onnx=True)  # compares the outputs
    assert 10 < np.load(tmp_path / "xfeat" / "check" / "mask.npy").sum() < 100


def test_shapes_and_options_that_do_not_fit_are_refused(extractor, tmp_path):
    with pytest.raises(InputError, match=r"image_size=\[64, 96\]: expected that of the extractor, \[96, 64\]"):
        mfvpr.export(tmp_path / "xfeat", extractor, replace(SHAPES, image_size=(64, 96)))
    with pytest.raises(InputError, match="keypoints=2000: expected at most 1000, the extractor's max_keypoints"):
        mfvpr.export(tmp_path / "xfeat", extractor, replace(SHAPES, keypoints=2000))
    with pytest.raises(InputError, match="with_shift, with_confidence: expected a scorer or a system, got an extr"):
        mfvpr.export(tmp_path / "xfeat", extractor, SHAPES, with_shift=True)
