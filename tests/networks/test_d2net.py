"""D2-Net: as the public code (golden values), as an independent oracle, and where either has nothing to say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr import InputError
from mfvpr.features import D2NetFeatures, network
from mfvpr.features.network import compile_network
from mfvpr.networks import D2Net
from mfvpr.networks.d2net import detect, select, survey
from mfvpr.networks.layers import preprocess
from tests.builders import local
from tests.golden.make_d2net import CASES, PLAIN, projections, samples, texture
from tests.networks import d2net_oracle as oracle
from tests.networks.checkpoints import fill_published
from tests.random_checkpoints import d2net_shapes, random_checkpoint

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def model() -> D2Net:
    return fill_published("d2_tf", random_checkpoint(d2net_shapes()))


class Tiny(nnx.Module):
    """A network of the same stride that compiles fast: means of 4 x 4 px, smoothed, and six random mixtures of them."""

    def __init__(self) -> None:
        self.mixture = nnx.Param(jnp.asarray(np.random.default_rng(0).normal(size=(3, 6)), jnp.float32))

    def __call__(self, images):
        batch, height, width = images.shape[0], images.shape[1] // 4, images.shape[2] // 4
        blocks = images[:, : 4 * height, : 4 * width].reshape(batch, height, 4, width, 4, 3).mean((2, 4))
        smoothed = blocks[:, 1:, 1:] + blocks[:, :-1, 1:] + blocks[:, 1:, :-1] + blocks[:, :-1, :-1]
        return nnx.relu(smoothed @ self.mixture[...])


@pytest.fixture(scope="module")
def small() -> D2NetFeatures:
    return D2NetFeatures(Tiny(), image_size=(64, 48))


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.stack([texture(64, 48, seed) for seed in range(3)])


_detect = jax.jit(detect, static_argnums=1)


def detected(*maps, ratios=((1.0, 1.0),)):
    """Detections of one image's maps."""
    return _detect([jnp.asarray(dense) for dense in maps], ratios)


def smooth(seed: int, height: int = 12, width: int = 10, channels: int = 6) -> np.ndarray:
    """A map after ReLU: noise, blurred a little, with many maxima."""
    noise = np.random.default_rng(seed).normal(size=(height + 1, width + 1, channels))
    return np.maximum(noise[1:, 1:] + 0.5 * noise[:-1, 1:] + 0.5 * noise[1:, :-1], 0).astype(np.float32)


def assert_same(level, expected, ratio=1.0):
    """One map's Detections, and the oracle's keypoints."""
    count = len(expected)
    assert level.count == count
    np.testing.assert_array_equal(level.mask, np.arange(len(level.mask)) < count)
    points = np.array([(keypoint.x, keypoint.y) for keypoint in expected]).reshape(-1, 2) * ratio
    np.testing.assert_allclose(level.keypoints[:count], points, atol=1e-4)
    np.testing.assert_allclose(level.scores[:count], [keypoint.score for keypoint in expected], rtol=1e-6)
    for descriptor, keypoint in zip(level.descriptors, expected, strict=False):
        np.testing.assert_allclose(descriptor, keypoint.descriptor, atol=1e-5)


def assert_golden(features, golden, case, keypoints_atol, projections_atol):
    assert len(features.scores) == len(golden[f"{case}/scores"])
    np.testing.assert_allclose(features.keypoints, golden[f"{case}/keypoints"], atol=keypoints_atol)
    np.testing.assert_allclose(features.scores, golden[f"{case}/scores"], rtol=1e-5)
    expected = golden[f"{case}/projections"]
    np.testing.assert_allclose(projections(features.descriptors), expected, atol=projections_atol)


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", CASES, ids=str)
def test_maps_and_features_are_those_of_the_public_code(model, golden, case):
    maps = []

    class Observed(nnx.Module):
        """The network, whose maps are kept: one program gives them and the features."""

        def __init__(self) -> None:
            self.network = model

        def __call__(self, images):
            dense = self.network(images)
            jax.debug.callback(lambda dense: maps.append(np.asarray(dense)), dense, ordered=True)
            return dense

    size = (case.width, case.height)
    extractor = D2NetFeatures(Observed(), size, preprocessing=case.preprocessing, multiscale=case.multiscale)
    features = extractor(texture(*size)[None])[0].features
    jax.effects_barrier()
    (dense,) = maps[len(maps) // 2]  # at full size
    expected = golden[f"{case}/dense"]
    np.testing.assert_allclose(samples(dense), expected, rtol=1e-5, atol=1e-5 * expected.max())
    assert_golden(features, golden, case, 1e-3, 1e-5)
    assert len(features.scores) > 200
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(features.image_size, size)
    assert features.mask.all()


@pytest.fixture(scope="module")
def plain(model) -> D2NetFeatures:
    return D2NetFeatures(model, (PLAIN[0].width, PLAIN[0].height))


@pytest.mark.optimized
@pytest.mark.first_case
@pytest.mark.parametrize("case", PLAIN, ids=str)
def test_plain_areas_have_the_keypoints_of_the_public_code_and_no_more(plain, golden, case):
    """Fast convolutions that round by position would make peaks of what is level, and lose those at its rim."""
    (features,) = local(plain(case.image[None]))
    assert_golden(features, golden, case, 1e-2, 1e-4)
    assert len(features.scores) > 10


@pytest.mark.optimized
def test_neighbors_that_see_the_same_pixels_have_the_same_bits(model):
    """A position sees 92 x 92 px; elsewhere the fast convolutions are at work."""
    image = texture(160, 128)
    wide, tall = image.copy(), image.copy()
    wide[2:94, 30:126] = 200
    tall[30:126, 2:94] = 200
    maps = compile_network(model, lambda model, images: (model(images), nnx.relu(model.vgg(images, uniform=True))))
    (usual, wide, tall), (uniform, *_) = zip(
        *(maps(preprocess(image[None], "caffe")) for image in (image, wide, tall)), strict=True
    )
    np.testing.assert_array_equal(wide[0, 11, 18], wide[0, 11, 19])
    np.testing.assert_array_equal(tall[0, 18, 11], tall[0, 19, 11])
    if jax.default_backend() == "cpu":
        assert not np.array_equal(usual, uniform)
    np.testing.assert_allclose(usual, uniform, atol=1e-5 * uniform.max())


@pytest.mark.parametrize(("seed", "offset"), [*((seed, 0) for seed in range(6)), (0, -4)])
def test_detection_agrees_with_the_oracle(seed, offset):
    """Also without ReLU: of maps that are below the zeros around them."""
    dense = smooth(seed) + np.float32(offset)
    expected = oracle.keypoints(dense.astype(np.float64))
    assert expected
    assert_same(*detected(dense), expected)


FLAT = np.ones((6, 5, 6), np.float32)


@pytest.mark.parametrize(
    ("maps", "num_empty"),
    [
        ((smooth(0, 4, 7), smooth(1, 9, 15), smooth(2, 20, 31)), 0),
        ((FLAT, smooth(1)), 1),
    ],
    ids=["textured", "flat"],
)
def test_scales_agree_with_the_oracle(maps, num_empty):
    """A scale without keypoints adds nothing to the next."""
    expected = oracle.pyramid([dense.astype(np.float64) for dense in maps])
    assert sum(not keypoints for keypoints in expected) == num_empty
    ratios = ((2.0, 2.0), (1.0, 1.0), (0.5, 0.5))[: len(maps)]
    levels = detected(*maps, ratios=ratios)
    for level, keypoints, (ratio, _) in zip(levels, expected, ratios, strict=True):
        assert_same(level, keypoints, ratio)


def test_of_channels_that_tie_the_first_is_reported():
    dense = np.zeros((5, 5, 3), np.float32)
    dense[2, 2] = [0, 3, 3]
    twice = oracle.keypoints(dense.astype(np.float64))
    assert [keypoint.channel for keypoint in twice] == [1, 2]
    assert_same(*detected(dense), twice[:1])


@pytest.mark.parametrize("value", [0, 1, -1, np.nan, np.inf])
def test_a_constant_map_has_no_keypoints(value):
    (level,) = detected(np.full((6, 7, 4), value, np.float32))
    assert level.count == 0
    assert not level.mask.any()


def test_what_does_not_fit_is_counted_and_the_strongest_stay():
    dense = smooth(3)
    all_keypoints, few = jax.jit(lambda dense: [select(dense, survey(dense), slots) for slots in (1000, 5)])(dense)
    assert all_keypoints.mask.shape == (120,)
    count = int(all_keypoints.count)
    assert few.count == count > 5
    assert few.mask.all()
    strongest = np.sort(np.argsort(-all_keypoints.scores[:count], stable=True)[:5])
    np.testing.assert_array_equal(few.scores, all_keypoints.scores[strongest])
    np.testing.assert_array_equal(few.keypoints, all_keypoints.keypoints[strongest])
    np.testing.assert_allclose(few.descriptors, all_keypoints.descriptors[strongest], atol=1e-6)


@pytest.mark.parametrize("memory", [None, 1e9])  # of a CPU, of an accelerator
def test_crowded_images_are_extracted_again(small, images, monkeypatch, memory):
    monkeypatch.setattr(network, "device_bytes", lambda _: memory)
    monkeypatch.setattr(network, "_SHARE", 0.01)
    crowded = D2NetFeatures(small.model, small.image_size)
    for ours, expected in zip(local(crowded(images)), local(small(images)), strict=True):
        assert len(expected.scores) > 2
        jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, rtol=1e-5), ours, expected)


def test_the_highest_scores_are_kept_in_order(small, images):
    limited = D2NetFeatures(small.model, small.image_size, max_keypoints=4)
    for ours, unlimited in zip(local(limited(images)), local(small(images)), strict=True):
        strongest = np.sort(np.argsort(-unlimited.scores, kind="stable")[:4])
        np.testing.assert_array_equal(ours.scores, unlimited.scores[strongest])
        np.testing.assert_array_equal(ours.keypoints, unlimited.keypoints[strongest])
    assert limited(images[:0]) == []


@pytest.mark.slow
def test_an_image_without_keypoints_gives_empty_features(images):
    graph, state = nnx.split(Tiny())
    blind = nnx.merge(graph, jax.tree.map(jnp.zeros_like, state))
    for multiscale in (False, True):
        features = D2NetFeatures(blind, image_size=(64, 48), multiscale=multiscale)(images[:1])[0].features
        assert features.keypoints.shape == (0, 2)
        assert features.descriptors.shape == (0, 6)
        assert features.scores.shape == features.mask.shape == (0,)


@pytest.mark.parametrize(
    ("size", "multiscale", "words"), [((15, 64), False, "from 16"), ((64, 23), True, "24 x 24 px .*got 64 x 23")]
)
def test_images_too_small_are_refused(size, multiscale, words):
    with pytest.raises(InputError, match=words):
        D2NetFeatures(Tiny(), image_size=size, multiscale=multiscale)
