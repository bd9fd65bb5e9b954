"""SSM-VPR's two maps against the public code's numbers (tests/golden), and what the network promises."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr.networks import SsmVgg
from mfvpr.networks.ssm import STAGE1_STRIDE, STAGE2_STRIDE
from tests.golden.make_d2net import samples
from tests.golden.make_ssm_maps import CASES, checkpoint
from tests.networks.checkpoints import fill_published

pytestmark = pytest.mark.thorough

RELATIVE = 1e-5  # of the map's largest value


@cache
def published(seed):
    return fill_published("vgg16_places365", checkpoint(seed))


@partial(jax.jit, static_argnums=0)
def run(function, model, images):
    return function(model, model.preprocess(images))


def assert_same_map(dense, name, golden):
    assert dense.shape == tuple(golden[f"{name}/shape"])
    tolerance = RELATIVE * golden[f"{name}/largest"]
    np.testing.assert_allclose(samples(np.asarray(dense)), golden[name], rtol=0, atol=tolerance)


@pytest.mark.optimized
@pytest.mark.parametrize("case", [case for case in CASES if case.width == 224], ids=str)
def test_one_pass_gives_both_maps_of_the_public_code(case, golden):
    (first,), (second,) = run(SsmVgg.__call__, published(case.seed), case.image[None])
    assert_same_map(first, f"{case}/stage1", golden)
    assert_same_map(second, f"{case}/stage2", golden)


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", [case for case in CASES if case.width != 224], ids=str)
def test_each_map_alone_is_the_public_codes(case, golden):
    """The last of images that do not see each other."""
    images = np.stack([case.image[::-1], case.image]) if 1 in case.stages else case.image[None]
    for stage in case.stages:
        *_, dense = run({1: SsmVgg.stage1, 2: SsmVgg.stage2}[stage], published(case.seed), images)
        assert_same_map(dense, f"{case}/stage{stage}", golden)


@pytest.mark.parametrize("width, height", [(224, 224), (336, 336), (448, 448), (416, 416), (33, 101), (1, 1)])
def test_sizes_of_the_maps(width, height):
    graph, state = nnx.split(published(0))
    images = jax.ShapeDtypeStruct((2, height, width, 3), jnp.float32)
    maps = jax.eval_shape(lambda state, images: nnx.merge(graph, state)(images), state, images)
    for dense, stride in zip(maps, (STAGE1_STRIDE, STAGE2_STRIDE), strict=True):
        assert dense.shape == (2, -(-height // stride), -(-width // stride), 512)
