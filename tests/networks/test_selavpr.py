"""DINOv2 and SelaVPR against the public code's numbers (tests/golden), and their layers by definition."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import mfvpr
from mfvpr.checkpoints.conversion import TABLES
from mfvpr.features import GlobalDescriptor, SelaVprFeatures
from mfvpr.networks import SelaVpr, VisionTransformer
from mfvpr.networks.vit import TokenDescriptor, Upsampling
from mfvpr.utils import InputError, recipe_of
from mfvpr.utils.fingerprints import fingerprint
from tests.builders import make_matches
from tests.golden.make_netvlad import image, name, samples
from tests.golden.make_selavpr import BACKBONES, MATCHES, NETWORKS, SIZE, WIDTH, maps
from tests.networks.checkpoints import fill
from tests.networks.test_netvlad import assert_close
from tests.random_checkpoints import dinov2_shapes, random_checkpoint, selavpr_shapes

pytestmark = pytest.mark.thorough


def network(depth=1, registers=0, seed=0, width=1024):
    build = partial(SelaVpr, width, depth, width // 64, registers=registers)
    return fill(build, TABLES["selavpr"], random_checkpoint(selavpr_shapes(width, depth, registers, prefix=""), seed))


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", NETWORKS, ids=map(str, NETWORKS))
def test_descriptors_are_the_public_codes(golden, case):
    [description] = SelaVprFeatures(network(*case))(image(SIZE))
    [local] = description.local
    key = name("network", *case)
    assert_close(description.vector, golden[f"{key}/global"])
    assert local.descriptors.shape == (61 * 61, 128)
    assert_close(samples(local.descriptors), golden[f"{key}/local"])
    assert_close(local.descriptors.astype(np.float64).mean(axis=0), golden[f"{key}/means"])


@pytest.mark.optimized
@pytest.mark.parametrize("case", BACKBONES, ids=map(str, BACKBONES))
def test_tokens_are_the_public_codes(golden, case):
    """Positions are resized unless the size is that of the training; images need not be square."""
    depth, registers, adapted, size, seed = case
    if adapted:
        backbone = random_checkpoint(dinov2_shapes(WIDTH, depth, registers, adapted=True), seed)
        checkpoint = random_checkpoint(selavpr_shapes(WIDTH, depth, registers, prefix=""), seed)
        checkpoint |= {f"backbone.{key}": value for key, value in backbone.items()}
        transformer = fill(
            partial(SelaVpr, WIDTH, depth, 4, registers=registers), TABLES["selavpr"], checkpoint
        ).backbone
    else:
        build = partial(VisionTransformer, WIDTH, depth, 4, registers=registers)
        checkpoint = random_checkpoint(dinov2_shapes(WIDTH, depth, registers), seed)
        transformer = fill(build, TABLES["dinov2"], checkpoint)
    class_token, tokens = nnx.jit(type(transformer).__call__)(transformer, transformer.preprocess(image(size)))
    key = name("backbone", *case[:3], *size, seed)
    assert tokens.shape == (1, size[1] // 14, size[0] // 14, WIDTH)
    assert_close(class_token[0], golden[f"{key}/whole"])
    assert_close(samples(np.asarray(tokens)), golden[f"{key}/maps"])


@pytest.mark.optimized
@pytest.mark.parametrize("case", MATCHES, ids=map(str, MATCHES))
def test_scores_are_the_public_codes(golden, case):
    """Numbers of mutual matches, equal as integers; a single match counts nothing there."""
    matches = mfvpr.match_candidates(*(as_features(local_map) for local_map in maps(*case)))
    published, counted = (mfvpr.score_candidates(mfvpr.MatchCount(single), matches) for single in ("zero", "count"))
    np.testing.assert_array_equal(published, golden[name("scores", *case)])
    np.testing.assert_array_equal(np.where(counted == 1, 0, counted), published)
    assert (counted >= 1).all()  # the nearest pair of all is mutual
    assert (case[0] == 1) == (counted == 1).all()


@pytest.mark.parametrize(
    ("confidence", "published"),
    [
        ([0.5, 0.0], 0.0),
        ([0.5, 0.25], 0.75),
        ([0.0, 0.0], 0.0),
        ([np.nan, 0.25], np.nan),
        ([np.nan, 0.0], np.nan),
    ],
)
def test_a_single_match_is_one_with_confidence(confidence, published):
    matches = make_matches(np.zeros((2, 2)), np.ones((2, 2)), capacity=4)
    matches = replace(matches, confidence=np.array([*confidence, np.nan, np.nan], np.float32))
    np.testing.assert_array_equal(mfvpr.MatchCount("zero")(matches), np.float32(published))
    np.testing.assert_array_equal(mfvpr.MatchCount()(matches), np.float32(sum(confidence)))


def as_features(values):
    rows = values.reshape(*values.shape[:-3], -1, values.shape[-1])
    return mfvpr.Features(
        keypoints=np.zeros((*rows.shape[:-1], 2), np.float32),
        descriptors=rows,
        scores=np.ones(rows.shape[:-1], np.float32),
        mask=np.ones(rows.shape[:-1], bool),
        image_size=np.full((*rows.shape[:-2], 2), 224, np.float32),
    )


def test_upsampling_is_the_sum_of_what_positions_add():
    rng = np.random.default_rng(0)
    with jax.numpy_dtype_promotion("standard"):
        layer = Upsampling(5, 3, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.asarray(rng.normal(size=3), jnp.float32)
    x = rng.normal(size=(2, 3, 4, 5)).astype(np.float32)
    expected = np.zeros((2, 7, 9, 3))  # with a border, which is dropped
    for row, column, a, b in np.ndindex(3, 4, 3, 3):
        expected[:, 2 * row + a, 2 * column + b] += x[:, row, column] @ np.asarray(layer.kernel[...], float)[a, b]
    expected = expected[:, 1:-1, 1:-1] + np.asarray(layer.bias[...])
    np.testing.assert_allclose(layer(jnp.asarray(x)), expected, atol=1e-5)


def test_features_lie_between_the_middles_of_patches():
    size = (42, 28)
    extractor = SelaVprFeatures(network(width=64), size)
    [description] = extractor(image(size))
    [local] = description.local
    assert extractor.scales == ((128, 9 * 5, 1.0),)
    assert (extractor.vector_size, description.vector.shape) == (64, (64,))
    np.testing.assert_allclose(np.linalg.norm(local.descriptors, axis=1), 1, rtol=1e-5)
    keypoints = local.keypoints.reshape(5, 9, 2)
    np.testing.assert_array_equal(keypoints[0, :, 0], 6.5 + 3.5 * np.arange(9))  # every fourth a patch's middle
    np.testing.assert_array_equal(keypoints[:, 0, 1], 6.5 + 3.5 * np.arange(5))
    assert (keypoints.max(axis=(0, 1)) == np.array(size) - 7.5).all()
    floats = extractor(image(size).astype(np.float32))[0]
    np.testing.assert_allclose(floats.vector, description.vector, atol=1e-6)


@pytest.mark.parametrize("size", [(224, 225), (28, 35)])
def test_sizes_without_whole_patches_are_refused(size):
    model = network(width=64)
    for extractor in (SelaVprFeatures, lambda model, size: GlobalDescriptor(TokenDescriptor(model.backbone), size)):
        with pytest.raises(InputError, match=r"image_size=\[.*\]: .*multiples of 14"):
            extractor(model, size)


def test_tokens_are_descriptors_of_images():
    shapes = dinov2_shapes(64, 2)
    transformer = fill(partial(VisionTransformer, 64, 2, 4), TABLES["dinov2"], random_checkpoint(shapes))
    size = (42, 28)
    class_token, token_maps = transformer(transformer.preprocess(image(size)))
    tokens = np.asarray(token_maps[0], np.float64).reshape(-1, 64)
    tokens /= np.linalg.norm(tokens, axis=1, keepdims=True)
    means = {power: np.mean(np.maximum(tokens, 1e-6) ** power, axis=0) ** (1 / power) for power in (1.0, 3.0)}
    recipes = set()
    for pooling, power, expected in (("cls", 3.0, class_token[0]), ("gem", 3.0, means[3.0]), ("gem", 1.0, means[1.0])):
        extractor = GlobalDescriptor(TokenDescriptor(transformer, pooling, power), size)
        np.testing.assert_allclose(extractor(image(size))[0].vector, expected / np.linalg.norm(expected), atol=1e-6)
        recipes.add(fingerprint(recipe_of(extractor)))
    assert len(recipes) == 3  # stores of one are not read for another
