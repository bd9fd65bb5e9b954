"""Bilinear values: against loops, against the definition of the finer grid, and outside."""

import jax
import numpy as np
import pytest

from mfvpr.networks.sampling import sample, upsample
from tests.networks import aliked_oracle as oracle


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
    finer = jax.jit(upsample, static_argnums=1)(dense[:height, :width], factor)
    assert finer.shape == (height * factor, width * factor, 3)
    y = np.linspace(0, height - 1, height * factor)
    x = np.linspace(0, width - 1, width * factor)
    expected = [[oracle.sampled(dense, column, row) for column in x] for row in y]
    np.testing.assert_allclose(finer, expected, atol=1e-5)
