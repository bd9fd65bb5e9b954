"""SSM-VPR's two maps against the public code's numbers (tests/golden), and what the network promises."""

from functools import cache, partial

import jax
import numpy as np
import pytest

from tests.golden.make_d2net import samples
from tests.golden.make_ssm_maps import CASES, checkpoint
from tests.networks.checkpoints import fill_published

pytestmark = pytest.mark.thorough

RELATIVE = 1e-5  # of the map's largest value


@cache
def published(seed):
    return fill_published("vgg16_places365", checkpoint(seed))


@partial(jax.jit, static_argnums=2)
def run(model, images, stage):
    return model(model.preprocess(images), stage)


def assert_same_map(dense, name, golden):
    assert dense.shape == tuple(golden[f"{name}/shape"])
    tolerance = RELATIVE * golden[f"{name}/largest"]
    np.testing.assert_allclose(samples(np.asarray(dense)), golden[name], rtol=0, atol=tolerance)


@pytest.mark.slow
@pytest.mark.optimized
@pytest.mark.parametrize("case", [case for case in CASES if case.width == 224], ids=str)
def test_both_maps_are_the_public_codes(case, golden):
    for stage in (1, 2):
        (dense,) = run(published(case.seed), case.image[None], stage)
        assert_same_map(dense, f"{case}/stage{stage}", golden)


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", [case for case in CASES if case.width != 224], ids=str)
def test_each_map_alone_is_the_public_codes(case, golden):
    """The last of images that do not see each other."""
    images = np.stack([case.image[::-1], case.image]) if 1 in case.stages else case.image[None]
    for stage in case.stages:
        *_, dense = run(published(case.seed), images, stage)
        assert_same_map(dense, f"{case}/stage{stage}", golden)
