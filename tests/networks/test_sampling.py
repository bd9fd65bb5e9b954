"""Bilinear values: against loops, against the definition of the finer grid, and outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr.networks.sampling import neighbors, sample, upsample
from tests.networks import aliked_oracle as oracle


@pytest.fixture(scope="module")
def dense() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)


def test_values_between_pixels_and_outside_agree_with_the_oracle(dense):
    points = np.random.default_rng(1).uniform(-3, 9, (40, 5, 2)).astype(np.float32)
    expected = [oracle.sampled(dense, x, y) for x, y in points.reshape(-1, 2)]
    sampled = jax.jit(sample)(dense, points)
    assert sampled.shape == (40, 5, 3)
    np.testing.assert_allclose(sampled.reshape(-1, 3), expected, atol=1e-5)


def test_pixels_are_themselves_and_fade_out_beyond_the_border(dense):
    points = np.array([[6, 4], [6.25, 4], [6, 4.5], [-0.5, -0.5], [7, 4], [-1, 0], [1e6, 0], [0, -1e6]], np.float32)
    corner, first = dense[4, 6], dense[0, 0]
    expected = np.stack([corner, 0.75 * corner, 0.5 * corner, 0.25 * first, *np.zeros((4, 3))])
    np.testing.assert_allclose(jax.jit(sample)(dense, points), expected, atol=1e-6)


@pytest.mark.parametrize("factor", [1, 2, 8])
def test_the_finer_grid_has_the_same_corners(dense, factor):
    finer = jax.jit(upsample, static_argnums=1)(dense, factor)
    assert finer.shape == (5 * factor, 7 * factor, 3)
    y, x = np.meshgrid(np.linspace(0, 4, 5 * factor), np.linspace(0, 6, 7 * factor), indexing="ij")
    expected = [oracle.sampled(dense, *place) for place in zip(x.flat, y.flat, strict=True)]
    np.testing.assert_allclose(finer.reshape(-1, 3), expected, atol=1e-5)


def test_a_single_pixel_is_repeated():
    pixel = jnp.arange(3.0)[None, None, None]
    finer = jax.jit(upsample, static_argnums=1)(pixel, 32)
    np.testing.assert_array_equal(finer, np.broadcast_to(pixel, finer.shape))
    assert finer.shape == (1, 32, 32, 3)


def test_a_window_is_cut_from_the_finer_grid():
    line, window = neighbors(10, 320), neighbors(10, 320, slice(16, 300))
    for of_line, of_window in zip(line, window, strict=True):
        np.testing.assert_array_equal(of_line[16:300], of_window)
