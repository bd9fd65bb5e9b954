"""Layers that networks share, and VGG16: against float64 sums by definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mfvpr.networks import Vgg16
from mfvpr.networks.layers import Conv3x3, preprocess, sample, stretch, winograd
from tests.networks import aliked_oracle as oracle

pytestmark = pytest.mark.thorough


def convolved(x, kernel, dilation):
    """`[B, H, W, C]` with `[3, 3, C, D]`, zeros outside, in float64."""
    height, width = x.shape[1:3]
    padded = np.pad(x.astype(np.float64), ((0, 0), (dilation, dilation), (dilation, dilation), (0, 0)))
    result = 0
    for row, column in np.ndindex(3, 3):
        down, right = row * dilation, column * dilation
        result = result + padded[:, down : down + height, right : right + width] @ kernel[row, column].astype(float)
    return result


@pytest.mark.parametrize("height, width, dilation, channels", [(1, 1, 2, 5), (8, 8, 1, 130), (9, 7, 2, 130)])
def test_convolutions_agree_with_their_definition(height, width, dilation, channels):
    rng = np.random.default_rng(height)
    x = rng.normal(size=(2, height, width, channels)).astype(np.float32)
    layer = Conv3x3(channels, 3, dilation=dilation, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(3, dtype=jnp.float32)
    fast = jax.jit(lambda x, kernel: winograd(x, kernel, dilation))(x, layer.kernel[...])
    expected = convolved(x, np.asarray(layer.kernel[...]), dilation)
    tolerance = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(layer(x), expected + np.arange(3), atol=tolerance)
    np.testing.assert_allclose(fast, expected, atol=tolerance)


def halved(x, *, ceil):
    """Maxima of 2 x 2, in loops; with `ceil` also of what is left at the ends."""
    rows, columns = ((size + ceil) // 2 for size in x.shape[1:3])
    result = np.zeros((len(x), rows, columns, x.shape[3]))
    for row, column in np.ndindex(rows, columns):
        result[:, row, column] = x[:, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2].max((1, 2))
    return result


@pytest.mark.parametrize("pool", ["max", "max_ceil"])
@pytest.mark.parametrize("height, width", [(4, 6), (5, 6), (4, 7), (5, 7), (1, 3)])
def test_odd_rows_and_columns_are_dropped_or_pooled_by_themselves(pool, height, width):
    model = Vgg16("conv2_1", pools=(pool,), rngs=nnx.Rngs(0))
    image = np.random.default_rng(0).normal(size=(1, height, width, 3)).astype(np.float32)
    expected = image
    for name in ("conv1_1", "conv1_2"):
        expected = np.maximum(convolved(expected, np.asarray(getattr(model, name).kernel[...]), 1), 0)
    expected = convolved(halved(expected, ceil=pool == "max_ceil"), np.asarray(model.conv2_1.kernel[...]), 1)
    actual = model(image)
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-5 * max(np.abs(expected).max(initial=0), 1))


@pytest.mark.optimized
def test_bytes_are_preprocessed_to_the_last_bit():
    byte = np.arange(256, dtype=np.uint8)
    image = np.stack([byte, byte[::-1], np.roll(byte, 7)], axis=-1)[None, None]
    mean = np.array([103.939, 116.779, 123.68])  # blue comes first
    expected = (image[..., ::-1].astype(np.float32) - mean).astype(np.float32)
    np.testing.assert_array_equal(preprocess(image, "caffe"), expected)
    np.testing.assert_allclose(preprocess(image.astype(np.float32), "caffe"), expected, atol=1e-5)
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    expected = ((image.astype(np.float32) / np.float32(255) - mean) / deviation).astype(np.float32)
    np.testing.assert_array_equal(preprocess(image, "torch"), expected)
    np.testing.assert_allclose(preprocess(image.astype(np.float32), "torch"), expected, atol=1e-5)


@pytest.fixture(scope="module")
def dense() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)


def test_values_between_pixels_and_outside_agree_with_the_oracle(dense):
    points = np.random.default_rng(1).uniform(-3, 9, (40, 5, 2)).astype(np.float32)
    points[0] = [[6, 4], [7, 4], [-1, 0], [1e6, 0], [0, -1e6]]  # on pixels, and far from the map
    expected = [oracle.sampled(dense, x, y) for x, y in points.reshape(-1, 2)]
    sampled = jax.jit(sample)(dense, points)
    assert sampled.shape == (40, 5, 3)
    np.testing.assert_allclose(sampled.reshape(-1, 3), expected, atol=1e-5)


@pytest.mark.parametrize("height, width, factor", [(5, 7, 1), (5, 7, 2), (5, 7, 8), (1, 1, 32)])
def test_the_finer_grid_has_the_same_corners(dense, height, width, factor):
    finer = jax.jit(stretch, static_argnums=(1, 2))(dense[:height, :width], factor * height, factor * width)
    assert finer.shape == (height * factor, width * factor, 3)
    y = np.linspace(0, height - 1, height * factor)
    x = np.linspace(0, width - 1, width * factor)
    expected = [[oracle.sampled(dense, column, row) for column in x] for row in y]
    np.testing.assert_allclose(finer, expected, atol=1e-5)
