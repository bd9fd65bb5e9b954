"""SSM-VPR's two maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr.models import imagenet
from mfvpr.models.ssm import SsmVgg


@pytest.fixture(scope="module")
def model():
    return SsmVgg(rngs=nnx.Rngs(0))


@pytest.mark.parametrize(
    "pixels, first, second",
    [((224, 224), (14, 14), (28, 28)), ((336, 336), (21, 21), (42, 42)), ((448, 448), (28, 28), (56, 56)),
     ((416, 416), (26, 26), (52, 52)), ((101, 33), (7, 3), (13, 5))],
)  # fmt: skip
def test_sizes_of_the_maps(model, pixels, first, second):
    graph, state = nnx.split(model)
    images = jax.ShapeDtypeStruct((2, *pixels, 3), jnp.float32)
    both = jax.eval_shape(lambda state, images: nnx.merge(graph, state)(images), state, images)
    assert [maps.shape for maps in both] == [(2, *first, 512), (2, *second, 512)]


def test_one_pass_gives_what_each_stage_gives(model):
    image = np.random.default_rng(0).normal(size=(1, 37, 24, 3)).astype(np.float32)
    first, second = model(image)
    assert (first < 0).any()
    assert (second < 0).any()
    np.testing.assert_array_equal(first, model.stage1(image))
    np.testing.assert_array_equal(second, model.stage2(image))


def test_pixels_are_torchs_unless_caffes_are_asked_for():
    image = np.random.default_rng(0).integers(0, 256, (1, 4, 4, 3), np.uint8)
    np.testing.assert_array_equal(SsmVgg.preprocess(image), imagenet.preprocess(image, "torch"))
    np.testing.assert_array_equal(SsmVgg.preprocess(image, "caffe"), imagenet.preprocess(image, "caffe"))
