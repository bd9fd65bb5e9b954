"""DINOv2's features of patches against the public code's numbers (tests/golden), and by definition."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from flax import nnx

from mfvpr.checkpoints.conversion import TABLES
from mfvpr.features import Dinov2Features, GlobalDescriptor
from mfvpr.networks import VisionTransformer
from mfvpr.networks.vit import TokenDescriptor
from mfvpr.utils import InputError
from tests.golden.make_dinov2 import CASES, HEADS, WIDTH
from tests.golden.make_netvlad import image, name, samples
from tests.networks.checkpoints import fill
from tests.networks.test_netvlad import assert_close
from tests.random_checkpoints import dinov2_shapes, random_checkpoint

pytestmark = pytest.mark.thorough

FACETS = ("token", "query", "key", "value")


def network(depth=2, registers=0, seed=0):
    build = partial(VisionTransformer, WIDTH, depth, HEADS, registers=registers)
    return fill(build, TABLES["dinov2"], random_checkpoint(dinov2_shapes(WIDTH, depth, registers), seed))


@pytest.mark.optimized
@pytest.mark.parametrize("case", CASES, ids=map(str, CASES))
def test_outputs_of_a_block_are_the_public_codes(golden, case):
    depth, registers, size, index, seed = case
    model = network(depth, registers, seed)
    with_block = nnx.jit(VisionTransformer.with_block, static_argnums=2)
    tokens, output = with_block(model, model.preprocess(image(size)), index)
    key = name(*case[:2], *size, index, seed)
    assert_close(tokens.class_token[0], golden[f"{key}/class"])
    for facet in FACETS:
        values = np.asarray(getattr(output, facet))
        assert values.shape == (1, size[1] // 14, size[0] // 14, WIDTH)
        assert_close(samples(values), golden[f"{key}/{facet}"])
    assert_close(output.attention.reshape(-1), golden[f"{key}/attention"])


@pytest.mark.parametrize("facet", FACETS)
def test_features_are_outputs_of_the_block(facet):
    size, model = (42, 28), network(registers=4)
    [description] = Dinov2Features(model, size, facet=facet, block=-2)(image(size))
    [local] = description.local
    tokens, output = model.with_block(model.preprocess(image(size)), 0)
    expected = np.asarray(getattr(output, facet), np.float64).reshape(6, WIDTH)
    np.testing.assert_allclose(local.descriptors, expected / np.linalg.norm(expected, axis=1)[:, None], atol=1e-6)
    attention = np.asarray(output.attention).reshape(-1)
    np.testing.assert_allclose(local.scores, attention / attention.max(), rtol=1e-5)
    assert local.scores.min() < local.scores.max() == 1
    assert local.mask.all()
    np.testing.assert_array_equal(local.image_size, size)
    last = model(model.preprocess(image(size)))
    np.testing.assert_allclose(tokens.maps, last.maps, atol=1e-6)


@pytest.mark.parametrize(("column", "row"), [(4, 1), (0, 0), (2, 2)])
def test_a_keypoint_is_the_middle_of_the_pixels_that_its_value_depends_on(column, row):
    """Values of the first block depend on the pixels of their own patch only."""
    size = (70, 42)
    extractor = Dinov2Features(network(depth=1), size, facet="value", block=0)
    before, rng = image(size), np.random.default_rng(0)
    after = before.copy()
    after[0, 14 * row : 14 * row + 14, 14 * column : 14 * column + 14] = rng.integers(0, 256, (14, 14, 3))
    changed_pixels = np.argwhere((before != after).any(axis=-1)[0])
    first, second = (extractor(images)[0].features for images in (before, after))
    np.testing.assert_array_equal(first.keypoints, second.keypoints)
    changes = np.abs(first.descriptors - second.descriptors).max(axis=1)
    [place] = np.flatnonzero(changes > 1e-4)
    span = changed_pixels.min(axis=0), changed_pixels.max(axis=0)
    np.testing.assert_array_equal(first.keypoints[place], np.mean(span, axis=0)[::-1])
    assert extractor.scales == ((WIDTH, len(first.keypoints), 1.0),) == ((WIDTH, 15, 1.0),)


def test_the_threshold_keeps_patches_with_much_attention():
    size = (70, 56)
    extractor = Dinov2Features(network(seed=1), size)
    every = extractor(image(size))[0].features
    for threshold in (float(np.median(every.scores)), 1.0):
        fewer = replace(extractor, threshold=threshold)(image(size))[0].features
        rows = [row for row in range(20) if every.scores[row] >= threshold]
        for part in ("keypoints", "descriptors", "scores"):
            np.testing.assert_array_equal(getattr(fewer, part), np.asarray(getattr(every, part))[rows])
        assert len(fewer.keypoints) == (1 if threshold == 1 else 10)


def test_the_global_descriptor_is_the_class_token_of_retrieval():
    size, model = (42, 28), network()
    features = Dinov2Features(model, size, facet="value", block=-2)
    expected = GlobalDescriptor(TokenDescriptor(model), size)
    assert features.vector_size == expected.vector_size == WIDTH
    np.testing.assert_allclose(features(image(size))[0].vector, expected(image(size))[0].vector, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"image_size": (224, 225)}, r"image_size=\[224, 225\]: expected multiples of 14"),
        ({"facet": "values"}, "facet=values: expected one of token, query, key, value"),
        ({"block": 2}, "block=2: expected from -2 to 1, a block of this network"),
        ({"block": -3}, "block=-3: expected from -2 to 1, a block of this network"),
        ({"threshold": 1.5}, "threshold=1.5: expected a number from 0 to 1"),
    ],
)
def test_wrong_settings_are_one_line(settings, words):
    with pytest.raises(InputError, match=f"^{words}[^\n]*$"):
        Dinov2Features(network(), **settings)
