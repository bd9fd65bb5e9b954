"""NetVLAD, its patches, and generalized means: against the public codes' numbers (tests/golden), and by definition."""

from functools import partial

import jax
import numpy as np
import pytest
from flax import nnx

from mfvpr.checkpoints.checkpoint import read_checkpoint
from mfvpr.checkpoints.conversion import TABLES
from mfvpr.features import GlobalDescriptor
from mfvpr.networks import NetVlad, VggNetVlad
from mfvpr.networks.global_descriptors import CHANNELS
from mfvpr.networks.layers import GeneralizedMean
from mfvpr.utils import InputError
from tests.golden.make_netvlad import CASES, GEM, MATLAB, PATCHES, image, name, samples
from tests.networks.checkpoints import fill, fill_netvlad, fill_published
from tests.random_checkpoints import gem_shapes, matlab_netvlad, random_checkpoint, write_matlab

pytestmark = pytest.mark.thorough

RELATIVE = 1e-5  # of the largest value


def assert_close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=RELATIVE * np.abs(expected).max())


def assert_separate_images(extractor, compilations):
    """Images of a batch do not see each other, and one program is compiled."""
    upright = image(extractor.image_size)
    images = np.concatenate([upright, upright[:, ::-1]])
    compilations.reset()
    both = [description.vector for description in extractor(images)]
    np.testing.assert_array_equal(both[1], extractor(images[1:])[0].vector)
    assert compilations.count == 1
    assert np.abs(both[0] - both[1]).max() > 1e-3


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", CASES, ids=map(str, CASES))
def test_descriptors_and_patches_are_the_public_codes(golden, case):
    clusters, outputs, size, seed = case
    network = fill_netvlad(clusters, outputs, seed)
    sizes = PATCHES.get(outputs, ())
    with_patches = nnx.jit(VggNetVlad.with_patches, static_argnums=2)
    descriptors, patches = with_patches(network, network.preprocess(image(size)), sizes)
    key, (width, height) = name("patch", *case), (side // 16 for side in size)
    assert descriptors.shape == (1, outputs or clusters * CHANNELS)
    assert_close(descriptors[0] if outputs else samples(np.asarray(descriptors)), golden[f"{key}/global"])
    for patch, patch_descriptors in zip(sizes, patches, strict=True):
        assert patch_descriptors.shape == (1, (height - patch + 1) * (width - patch + 1), outputs)
        assert_close(samples(np.asarray(patch_descriptors[0])), golden[f"{key}/{patch}"])
        assert_close(np.asarray(patch_descriptors[0], np.float64).mean(axis=0), golden[f"{key}/{patch}/means"])


@pytest.mark.optimized
@pytest.mark.slow
def test_the_originals_file_gives_the_descriptors_of_hlocs_code(golden, tmp_path):
    clusters, outputs, size, seed = MATLAB
    read = read_checkpoint(write_matlab(tmp_path / "struct.mat", matlab_netvlad(clusters, outputs, seed)))
    network = fill(partial(VggNetVlad, clusters, outputs, original=True), TABLES["netvlad_matlab"], read)
    vector = GlobalDescriptor(network, size)(image(size))[0].vector
    assert_close(vector, golden[name("matlab", *MATLAB)])
    floats = GlobalDescriptor(network, size)(image(size).astype(np.float32))[0].vector
    np.testing.assert_allclose(floats, vector, atol=1e-7)


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", GEM, ids=map(str, GEM))
def test_generalized_means_are_cosplaces(golden, case):
    backbone, outputs, size, seed = case
    model = fill_published(f"cosplace_{backbone}_{outputs}", random_checkpoint(gem_shapes(backbone, outputs), seed))
    extractor = GlobalDescriptor(model, size)
    assert (extractor.vector_size, extractor.scales) == (outputs, ())
    assert_close(extractor(image(size))[0].vector, golden[name("gem", *case)])


@pytest.mark.parametrize("order", ["clusters", "channels"])
def test_layer_and_patches_are_those_of_loops(order):
    rng = np.random.default_rng(0)
    maps = rng.normal(size=(2, 4, 5, CHANNELS))
    with jax.numpy_dtype_promotion("standard"):
        layer = NetVlad(3, order, rngs=nnx.Rngs(0))
    layer.centers[...] = jax.numpy.asarray(rng.normal(size=(3, CHANNELS)) / 20, np.float32)
    kernel, centers = (np.asarray(parameter[...], np.float64) for parameter in (layer.assignment.kernel, layer.centers))

    def pooled(vectors):
        sums = np.zeros((3, CHANNELS))
        for x in vectors.reshape(-1, CHANNELS):
            x = x / np.linalg.norm(x)
            odds = np.exp(x @ kernel)
            sums += (odds / odds.sum())[:, None] * (x - centers)
        sums /= np.linalg.norm(sums, axis=1, keepdims=True)
        flat = (sums if order == "clusters" else sums.T).reshape(-1)
        return flat / np.linalg.norm(flat)

    single = jax.numpy.asarray(maps, np.float32)
    np.testing.assert_allclose(layer(single), [pooled(parameter) for parameter in maps], atol=1e-6)
    for size in (1, 2, 4):
        expected = [
            [
                pooled(parameter[row : row + size, column : column + size])
                for row in range(5 - size)
                for column in range(6 - size)
            ]
            for parameter in maps
        ]
        np.testing.assert_allclose(layer.patches(single, size), expected, atol=1e-6)


def test_where_a_map_is_zero_there_is_no_nan():
    with jax.numpy_dtype_promotion("standard"):
        layer = NetVlad(2, rngs=nnx.Rngs(0))
    zero = np.zeros((1, 3, 3, CHANNELS), np.float32)
    assert not np.asarray(layer(zero)).any()
    assert not np.asarray(layer.patches(zero, 2)).any()


@pytest.mark.parametrize("power", [1.0, 2.5, 30.0, 1000.0])
@pytest.mark.parametrize("unit", [1.0, 0.03])
def test_the_generalized_mean_is_its_definition(power, unit):
    """Also where powers of small values, as those of long vectors of unit length, would be 0 in float32."""
    maps = unit * np.random.default_rng(0).normal(size=(2, 3, 4, 5)).astype(np.float32)
    positive = np.maximum(maps.astype(np.float64), 1e-6)
    largest = positive.max(axis=(1, 2), keepdims=True)
    expected = largest[:, 0, 0] * np.mean((positive / largest) ** power, axis=(1, 2)) ** (1 / power)
    np.testing.assert_allclose(GeneralizedMean(power)(jax.numpy.asarray(maps)), expected, rtol=1e-5)
    constant = np.full((1, 2, 2, 3), 0.7, np.float32)
    np.testing.assert_allclose(GeneralizedMean(power)(jax.numpy.asarray(constant)), 0.7, rtol=1e-5)


@pytest.fixture(scope="module")
def small():
    return fill_netvlad(4, 8)


@pytest.mark.slow
def test_fewer_components_are_the_first_of_all(small):
    every, first = (GlobalDescriptor(small, (64, 48), components=number) for number in (None, 3))
    assert (every.vector_size, first.vector_size) == (8, 3)
    all_components, part = (extractor(image((64, 48)))[0].vector for extractor in (every, first))
    np.testing.assert_allclose(part, all_components[:3] / np.linalg.norm(all_components[:3]), atol=1e-6)


@pytest.mark.optimized
def test_images_of_a_batch_do_not_see_each_other_and_one_program_is_compiled(small, compilations):
    assert_separate_images(GlobalDescriptor(small, (64, 48)), compilations)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"image_size": (15, 100)}, "image_size=.*from 16"),
        ({"components": 9}, "components=9: expected null, or at most 8"),
    ],
)
def test_what_cannot_be_is_refused(small, options, words):
    with pytest.raises(InputError, match=words):
        GlobalDescriptor(small, **options)
    with pytest.raises(InputError, match="components=3: expected null, as these weights"):
        GlobalDescriptor(fill_netvlad(4, None), components=3)
