"""MixVPR against the public code's numbers (tests/golden), and what its parts promise."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr.features import MixVprDescriptor
from mfvpr.networks import MixVPR
from mfvpr.networks.layers import preprocess
from mfvpr.utils import InputError
from tests.golden.make_mixvpr import SIZES, faint_maps, images
from tests.golden.make_netvlad import samples
from tests.networks.checkpoints import fill_published
from tests.networks.test_netvlad import RELATIVE, assert_close
from tests.random_checkpoints import mixvpr_shapes, random_checkpoint

pytestmark = pytest.mark.thorough


def published(channels, rows):
    return fill_published(f"mixvpr_{channels * rows}", random_checkpoint(mixvpr_shapes(channels, rows)))


@pytest.fixture(scope="module")
def model():
    return published(*SIZES[0])


@pytest.fixture(scope="module")
def computed(model):
    """All stages for both images at once."""

    @jax.jit
    def stages(model, images):
        maps = model.backbone(preprocess(images))
        mixed, mixers = maps.reshape(len(maps), 400, 1024).swapaxes(1, 2), []
        for mixer in model.mix:
            mixed = mixer(mixed)
            mixers.append(mixed)
        return {"maps": maps, "mixers": mixers}

    return SimpleNamespace(**stages(model, images()))


def assert_same_descriptors(actual, expected):
    assert actual.shape == expected.shape
    assert np.linalg.norm(actual - expected, axis=1).max() < RELATIVE


@pytest.mark.optimized
def test_backbone_and_mixers_are_the_public_codes(computed, golden):
    assert computed.maps.shape == (2, 20, 20, 1024)
    assert_close(samples(np.asarray(computed.maps)), golden["backbone"])
    assert_close(computed.maps.mean((1, 2)), golden["backbone/means"])

    for place, mixed in enumerate(computed.mixers):
        assert_close(samples(np.asarray(mixed)), golden[f"mixer{place}"])


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("channels, rows", SIZES)
def test_descriptors_are_the_public_codes(computed, golden, channels, rows):
    aggregate = jax.jit(MixVPR.aggregate)
    network, width = published(channels, rows), channels * rows
    assert_same_descriptors(aggregate(network, computed.maps), golden[f"{width}/descriptors"])
    assert_same_descriptors(aggregate(network, faint_maps()), golden[f"{width}/faint"])


def vectors(descriptions):
    return np.array([description.vector for description in descriptions])


@pytest.mark.optimized
def test_extractor_gives_the_public_codes_descriptors_and_compiles_once(model, golden, compilations):
    extractor = MixVprDescriptor(model, batch_size=2)
    assert (extractor.image_size, extractor.vector_size, extractor.interpolation) == ((320, 320), 4096, "pil_bicubic")
    compilations.reset()
    single, three = (vectors(extractor(images()[rows])) for rows in ([0], [0, 1, 0]))
    assert compilations.count == 1
    assert three.dtype == np.float32
    np.testing.assert_array_equal(three[[0, 2]], single[[0, 0]])
    assert_same_descriptors(three[:2], golden["4096/descriptors"])
    np.testing.assert_allclose(np.linalg.norm(three, axis=1), 1, rtol=1e-6)
    floats = vectors(extractor(images()[:1].astype(np.float32)))
    assert_same_descriptors(floats, single)


def test_other_image_sizes_are_refused(model):
    with pytest.raises(ValueError, match="320 x 320 px, got 640 x 480"):
        model(jnp.zeros((1, 480, 640, 3)))
    with pytest.raises(InputError, match=r"MixVprDescriptor: .*320 x 320 px, got 336 x 300"):
        MixVprDescriptor(model)(np.zeros((1, 300, 336, 3), np.uint8))
