"""The smooth maximum over bins, and the peak between bins, in float64 by NumPy."""

import jax
import numpy as np
import pytest

from mfvpr.core.lattice import climb, smooth_tallest

SIGMA = np.float32(8)


def fields(count):
    """`[count, ...]` starts at the highest of points 2.2 sigma apart, shifts, weights: few votes or many, clusters."""
    rng = np.random.default_rng(0)
    number = rng.choice([2, 3, 5, 20, 60], count)
    weights = np.where(np.arange(60) < number[:, None], rng.uniform(0.1, 1, (count, 60)), 0)
    reach = SIGMA * rng.choice([2, 6], (count, 1, 1))
    cluster = rng.uniform(-1, 1, (count, 1, 2)) * reach + rng.normal(0, 0.7 * SIGMA, (count, 60, 2))
    shifts = np.where(rng.random((count, 60, 1)) < 0.5, cluster, rng.uniform(-1, 1, (count, 60, 2)) * reach)
    axis = np.arange(-48, 49, 2.2 * SIGMA)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    offsets = shifts[:, None] - grid[None, :, None]
    heights = np.sum(weights[:, None] * np.exp(-0.5 * np.sum((offsets / SIGMA) ** 2, -1)), -1)
    return grid[heights.argmax(1)].astype(np.float32), shifts.astype(np.float32), weights.astype(np.float32)


def landscape(shift, shifts, weights):
    """Heights, slopes in sigmas, and curvatures of many sums of votes, relative to their heights."""
    scaled = (shifts - np.asarray(shift, np.float64)[:, None]) / SIGMA
    pull = weights * np.exp(-0.5 * np.sum(scaled**2, -1))
    height = pull.sum(1)
    pull = pull / height[:, None]
    curvature = np.einsum("nk,nki,nkj->nij", pull, scaled, scaled) - np.eye(2)
    return height, np.einsum("nk,nki->ni", pull, scaled), curvature


def test_the_peak_is_the_maximum_to_a_ten_thousandth_of_sigma():
    start, shifts, weights = fields(400)
    peak = jax.jit(jax.vmap(climb, in_axes=(0, 0, 0, None)))(start, shifts, weights, SIGMA)
    height, slope, curvature = landscape(peak, shifts, weights)
    assert (height >= (1 - 1e-6) * landscape(start, shifts, weights)[0]).all()
    assert np.linalg.eigvalsh(curvature).max() < 0
    left = np.linalg.solve(curvature, slope[..., None])[..., 0]
    assert np.linalg.norm(left, axis=1).max() < 1e-4


def test_derivatives_of_the_peak():
    """The first and the second along one direction of shifts, weights and sigma, beside differences of peaks."""
    start, shifts, weights = (values[0].astype(float) for values in fields(5))
    way, more = np.random.default_rng(1).normal(size=(2, 60))

    def peak(step):
        return climb(start, shifts + step * way[:, None], weights * (1 + step * more), float(SIGMA) * (1 + step))[0]

    steps = np.array([-1e-3, 0, 1e-3])
    with jax.enable_x64(True):
        slope = jax.grad(peak)
        peaks, slopes, bends = jax.jit(jax.vmap(lambda step: (peak(step), slope(step), jax.grad(slope)(step))))(steps)
    np.testing.assert_allclose(slopes[1], np.gradient(peaks, steps)[1], rtol=1e-4)
    np.testing.assert_allclose(bends[1], np.gradient(slopes, steps)[1], rtol=1e-4)


@pytest.mark.parametrize("peak", [3.0, 100.0])
def test_the_smooth_maximum_has_the_digits_of_float32_at_any_temperature(peak):
    rng = np.random.default_rng(0)
    values = rng.exponential(1e-3, (48, 48))
    values[5, 7:9] = peak, 0.7 * peak
    values, mask = np.float32(values), np.arange(48) < 40
    mask = mask[:, None] & mask
    smooth = jax.jit(jax.value_and_grad(lambda values, t: smooth_tallest(values, mask, temperature=t)))
    for temperature in np.geomspace(0.01, 1e4, 60).astype(np.float32):
        ratios = values[mask].astype(np.float64) / temperature
        powers = np.exp(ratios - ratios.max())
        expected = (
            np.log1p(np.expm1(ratios).mean()) if abs(ratios).max() < 500 else ratios.max() + np.log(powers.mean())
        )
        score, slopes = smooth(values, temperature)
        np.testing.assert_allclose(score, temperature * expected, rtol=1e-5)
        np.testing.assert_allclose(slopes[mask], powers / powers.sum(), rtol=3e-5, atol=1e-30)
        assert not np.asarray(slopes)[~mask].any()
