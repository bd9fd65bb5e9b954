"""ALIKED: as the public code (golden values), as an independent oracle, and where either has nothing to say."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr import InputError
from mfvpr.features import AlikedFeatures
from mfvpr.networks import Aliked
from mfvpr.networks.aliked import DeformableConv, DescriptorHead, _inside, detect, field
from mfvpr.networks.layers import sample, stretch
from tests.builders import local
from tests.golden.make_aliked import DRAWN, REAL, checkpoint, picture, projections, samples, texture
from tests.needs import ALIKED, PHOTOGRAPHS, needs
from tests.networks import aliked_oracle as oracle
from tests.networks.checkpoints import fill_published

pytestmark = pytest.mark.thorough

SLOTS = 1500
IMAGES = PHOTOGRAPHS / "grief_season"


def network(case) -> Aliked:
    return fill_published(case.variant, checkpoint(case, ALIKED))


@partial(jax.jit, static_argnums=(0, 4))
def everything(graph, state, images, threshold, capacity):
    """Dense maps and extracted features: one program per size for networks of the same shape."""
    network = nnx.merge(graph, state)
    images = images.astype(jnp.float32) / 255
    levels, scores = network.levels(images)
    dense = jax.vmap(lambda levels: dense_map(field(levels, *_inside(images))))(levels)
    return dense, scores, network.extract(images, threshold, capacity)


def dense_map(features):
    """Features of all pixels of a field."""
    y, x = jnp.indices(features.inverse_norm.shape)
    return features.at(y.reshape(-1), x.reshape(-1)).reshape(*y.shape, -1)


@pytest.fixture(scope="module")
def drawn() -> Aliked:
    return network(DRAWN)


def seeded(shape, seed=0, scale=1.0):
    return (scale * np.random.default_rng(seed).normal(size=shape)).astype(np.float32)


def randomized(build, scale: float) -> nnx.Module:
    """The module of `build` with random values throughout, biases too."""
    with jax.numpy_dtype_promotion("standard"):  # Flax's initializers mix types
        graph, state = nnx.split(nnx.eval_shape(lambda: build(rngs=nnx.Rngs(0))))
    leaves, structure = jax.tree.flatten(state)
    values = [jnp.asarray(seeded(leaf.shape, seed, scale)) for seed, leaf in enumerate(leaves)]
    return nnx.merge(graph, jax.tree.unflatten(structure, values))


def assert_golden(golden, case, features, scores, detections):
    np.testing.assert_allclose(samples(np.asarray(features)), golden[f"{case}/features"], atol=5e-6)
    np.testing.assert_allclose(samples(np.asarray(scores)[..., None]), golden[f"{case}/score_map"], atol=1e-5)
    mask, descriptors = np.asarray(detections.mask), detections.descriptors
    assert mask.sum() == min(detections.count, len(mask)) == len(golden[f"{case}/scores"])
    assert mask[: mask.sum()].all()
    np.testing.assert_allclose(detections.keypoints[mask], golden[f"{case}/keypoints"], atol=1e-4)
    np.testing.assert_allclose(detections.scores[mask], golden[f"{case}/scores"], atol=5e-5)
    np.testing.assert_allclose(projections(np.asarray(descriptors[mask])), golden[f"{case}/projections"], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(descriptors[mask], axis=1), 1, atol=1e-6)


@pytest.mark.optimized
@pytest.mark.first_case
@needs(ALIKED, PHOTOGRAPHS)
@pytest.mark.parametrize("case", REAL, ids=str)
def test_with_real_weights_everything_is_as_in_the_public_code(golden, case):
    images = np.stack([picture(case, IMAGES), texture(case.width, case.height)])
    results = everything(*nnx.split(network(case)), images, case.threshold, min(case.max_keypoints, SLOTS))
    assert_golden(golden, case, *jax.tree.map(lambda field: field[0], results))


@pytest.mark.slow
@pytest.mark.optimized
def test_with_random_weights_too_and_images_of_a_batch_do_not_mix(drawn, golden):
    image = picture(DRAWN, IMAGES)
    results = []
    for other in (np.full_like(image, 90), texture(DRAWN.width, DRAWN.height, seed=1)):
        batch = everything(*nnx.split(drawn), np.stack([image, other]), DRAWN.threshold, SLOTS)
        results.append(jax.tree.map(lambda field: field[0], batch))
        assert all(np.isfinite(field).all() for field in jax.tree.leaves(batch))
    assert_golden(golden, DRAWN, *results[0])
    jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.optimized
def test_the_extractor_does_as_the_public_code_and_compiles_once(drawn, golden, compilations):
    extractor = AlikedFeatures(drawn, (DRAWN.width, DRAWN.height), threshold=DRAWN.threshold)
    assert len(repr(extractor)) < 200
    image = picture(DRAWN, IMAGES)[None]
    features = extractor(image)[0].features
    compilations.reset()
    extractor(image[:, ::-1])
    assert compilations.count == 0
    np.testing.assert_allclose(features.keypoints, golden[f"{DRAWN}/keypoints"], atol=1e-4)
    np.testing.assert_allclose(projections(features.descriptors), golden[f"{DRAWN}/projections"], atol=1e-5)
    np.testing.assert_array_equal(features.image_size, [300, 200])
    assert features.mask.all()
    assert features.descriptors.shape[1] == extractor.scales[0].dimension == 64


def test_a_deformable_convolution_agrees_with_the_oracle():
    conv = randomized(partial(DeformableConv, 3, 4), 1.5)
    images = seeded((2, 6, 5, 3))
    results = jax.jit(lambda images: conv(images))(images)
    for image, ours in zip(images, results, strict=True):
        offsets = oracle.deformed(image, np.asarray(conv.offset.kernel[...]), np.zeros((6, 5, 18)))
        offsets += np.asarray(conv.offset.bias[...])
        assert (np.abs(offsets) > 1.5).any()  # a quarter of the longer side
        np.testing.assert_allclose(ours, oracle.deformed(image, np.asarray(conv.kernel[...]), offsets), atol=1e-4)


def pyramid(height, width, channels):
    return [seeded((height // factor, width // factor, channels), factor) for factor in (1, 2, 8, 32)]


def test_a_field_is_the_dense_map_where_it_is_asked_for():
    levels, window = pyramid(64, 96, 5), (slice(3, 60), slice(10, 85))
    points = np.random.default_rng(0).uniform(-2, 80, (200, 2)).astype(np.float32)
    x, y = np.random.default_rng(0).integers(-2, 80, (2, 200))

    @jax.jit
    def both(levels):
        features = field(levels, *window)
        maps = [stretch(level, *levels[0].shape[:2]) for level in levels]
        plain = jnp.concatenate(maps, axis=-1)[window]
        plain /= jnp.linalg.norm(plain, axis=-1, keepdims=True)
        return (dense_map(features), features.sample(points), features.at(y, x)), (plain, sample(plain, points))

    (dense, sampled, pixels), (plain, expected) = both(levels)
    np.testing.assert_allclose(dense, plain, atol=1e-6)
    np.testing.assert_allclose(sampled, expected, atol=1e-6)
    inside = (x >= 0) & (x < 75) & (y >= 0) & (y < 57)
    np.testing.assert_allclose(pixels[inside], plain[y[inside], x[inside]], atol=1e-6)
    assert not pixels[~inside].any()


def test_descriptors_agree_with_the_oracle_also_at_the_border():
    head = randomized(partial(DescriptorHead, 8, 4), 0.7)
    weights = dict(nnx.to_flat_state(nnx.state(head)))
    weights = {".".join(path): np.asarray(value[...]) for path, value in weights.items()}
    points = np.random.default_rng(0).uniform(0, [31, 25], (40, 2)).astype(np.float32)
    points[:4] = [[0, 0], [31, 25], [0.5, 25], [31, 0.5]]

    @jax.jit
    def described(levels):
        features = field(levels, slice(4, 30), slice(0, 32))
        return head(features, jnp.asarray(points), 40), dense_map(features)

    descriptors, dense = described(pyramid(32, 32, 2))
    expected = [oracle.described(np.asarray(dense, np.float64), point, weights) for point in points]
    np.testing.assert_allclose(descriptors, expected, atol=2e-5)


@pytest.fixture(scope="module")
def score_map() -> np.ndarray:
    """Smooth, with flat places."""
    noise = np.random.default_rng(0).uniform(size=(30, 26)) ** 3
    smooth = noise[1:-1, 1:-1] + 0.5 * (noise[:-2, 1:-1] + noise[2:, 1:-1] + noise[1:-1, :-2] + noise[1:-1, 2:])
    smooth[9:13, 10:14] = smooth.max()
    return (smooth / 3).astype(np.float32)


_detect = jax.jit(detect, static_argnums=2)


@pytest.mark.parametrize("threshold, capacity", [(0.3, 500), (0.1, 500), (0.99, 500), (0, 500), (0.1, 20), (0.99, 20)])
def test_detection_agrees_with_the_oracle(score_map, threshold, capacity):
    expected = oracle.keypoints(score_map.astype(np.float64), threshold or 1, capacity)
    detections = _detect(score_map, threshold, capacity)
    count = len(expected)
    assert count > 15
    assert detections.count == len(oracle.keypoints(score_map.astype(np.float64), threshold or 1, 500))
    np.testing.assert_array_equal(detections.mask, np.arange(len(detections.mask)) < count)
    np.testing.assert_allclose(detections.keypoints[:count], expected[:, :2], atol=1e-5)
    np.testing.assert_allclose(detections.scores[:count], expected[:, 2], atol=1e-6)
    assert (detections.count > capacity) == (capacity == 20)


@pytest.mark.parametrize("size", [320, 336])
def test_positions_are_rounded_as_the_original_rounds_them(size):
    peaks = np.zeros((7, size), np.float32)
    peaks[3, 3 : size - 3 : 5] = 1  # each alone in its neighborhood, so that the refinement does not move it
    keypoints = _detect(peaks, 0.5, 100).keypoints
    pixels = np.arange(3, size - 3, 5, dtype=np.float32)
    last, unit, two = np.float32(size - 1), np.float32(1), np.float32(2)
    expected = ((pixels / last * two - unit) / two + unit / two) * last
    assert (expected < pixels).any()  # which is truncated to the pixel before
    np.testing.assert_array_equal(keypoints[: len(pixels), 0], expected)


@pytest.mark.parametrize("value", [0, 0.5, 1, np.nan, np.inf])
@pytest.mark.parametrize("size", [(12, 9), (3, 4)])
def test_a_constant_map_has_keypoints_only_above_the_threshold(value, size):
    detections = _detect(np.full(size, value, np.float32), 0.7, 100)
    assert detections.count == (40 if value >= 0.7 and size == (12, 9) else 0)
    assert detections.mask.sum() == detections.count


class Direct(nnx.Module):
    """Its score map is the red channel, and its descriptors say where they are."""

    dimension = 2

    def extract(self, images, threshold, capacity):
        detections = jax.vmap(lambda scores: detect(scores, threshold, capacity))(images[..., 0])
        directions = detections.keypoints / jnp.linalg.norm(detections.keypoints, axis=-1, keepdims=True)
        return detections._replace(descriptors=directions)


def crowded() -> np.ndarray:
    """`[2, 40, 60, 3]`: many peaks, in one image too many for the usual number of slots."""
    images = np.zeros((2, 40, 60, 3), np.uint8)
    images[0, 3:37:3, 3:57:3, 0] = np.random.default_rng(0).permutation(216).reshape(12, 18) + 30
    images[1, 10:30:5, 10:50:5, 0] = 200
    return images


@pytest.fixture(scope="module")
def unlimited() -> AlikedFeatures:
    return AlikedFeatures(Direct(), (60, 40), max_keypoints=None)


def test_what_does_not_fit_the_usual_slots_is_not_lost(unlimited):
    first, second = local(unlimited(crowded()))
    assert len(first.scores) == 216
    assert len(second.scores) == 32
    for features in (first, second):
        assert (np.diff(np.rint(features.keypoints) @ [1, 60]) > 0).all()  # row by row
        directions = features.keypoints / np.linalg.norm(features.keypoints, axis=1, keepdims=True)
        np.testing.assert_allclose(features.descriptors, directions, atol=1e-6)


@pytest.mark.parametrize("limit", [50, 100])
def test_of_too_many_the_highest_scores_are_kept_by_falling_score(unlimited, limit):
    unlimited_features, _ = local(unlimited(crowded()))
    features, other = local(AlikedFeatures(Direct(), (60, 40), max_keypoints=limit)(crowded()))
    peaks = crowded()[0, 3:37:3, 3:57:3, 0].reshape(-1)
    strongest = np.argsort(-peaks.astype(int), kind="stable")[:limit]
    np.testing.assert_array_equal(features.keypoints, unlimited_features.keypoints[strongest])
    assert len(other.scores) == 32


def test_no_images_and_dark_images_have_no_features(unlimited):
    assert unlimited(crowded()[:0]) == []
    (features,) = local(unlimited(np.zeros((1, 40, 60, 3), np.uint8)))
    assert features.keypoints.shape == features.descriptors.shape == (0, 2)
    assert features.scores.shape == features.mask.shape == (0,)


def test_images_too_small_are_refused(drawn):
    with pytest.raises(InputError, match=r"image_size=\(60, 4\): expected a list of 2, each a whole number from 16"):
        AlikedFeatures(drawn, (60, 4))
