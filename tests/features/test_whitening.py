"""Principal components against a full singular value decomposition."""

from dataclasses import astuple

import numpy as np
import pytest

from mfvpr.features import whitening
from mfvpr.features.whitening import fit_whitening
from mfvpr.retrieval import WhitenedSearch
from mfvpr.utils import InputError


def samples(count, size, dtype=np.float64, rank=None):
    """Vectors of falling variance around a mean that is not 0."""
    rng = np.random.default_rng([count, size])
    rank = rank or min(count - 1, size)
    axes = np.linalg.qr(rng.normal(size=(size, rank)))[0]
    return (rng.normal(size=(count, rank)) * 0.9 ** np.arange(rank) @ axes.T + rng.normal(size=size)).astype(dtype)


def by_decomposition(sample, dimension):
    """As scikit-learn: the signs by the largest entry of each axis."""
    sample = sample.astype(np.float64)
    mean = sample.mean(axis=0)
    _, spread, axes = np.linalg.svd(sample - mean, full_matrices=False)
    axes = axes[:dimension]
    signs = np.sign(axes[np.arange(dimension), np.abs(axes).argmax(axis=1)])
    return mean, signs[:, None] * axes / (spread[:dimension, None] / np.sqrt(len(sample) - 1))


@pytest.mark.parametrize("shape", [(60, 25), (25, 60), (31, 30), (30, 30), (200, 150), (130, 140)], ids=str)
@pytest.mark.parametrize("block", [7, 2**25])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-6)])
def test_both_matrices_give_the_components_of_the_sample(shape, block, dtype, tolerance, monkeypatch):
    monkeypatch.setattr(whitening, "_BLOCK", block)
    sample = samples(*shape, dtype)
    fitted, (mean, components) = fit_whitening(sample, 12), by_decomposition(sample, 12)
    assert fitted.mean.dtype == fitted.components.dtype == dtype
    np.testing.assert_allclose(fitted.mean, mean, atol=tolerance)
    np.testing.assert_allclose(fitted.components, components, atol=tolerance * np.abs(components).max())
    white = (sample.astype(np.float64) - fitted.mean) @ fitted.components.T
    np.testing.assert_allclose(np.cov(white.T), np.eye(12), atol=100 * tolerance)


@pytest.mark.parametrize("shape", [(60, 25), (25, 60), (90, 100), (110, 90)], ids=str)
def test_a_component_without_variance_is_zero(shape):
    """Divided by its standard deviation, rounding errors would be as large as the other components."""
    fitted = fit_whitening(samples(*shape, np.float32, rank=5), 8)
    assert np.isfinite(fitted.components).all()
    assert fitted.components[:5].any(axis=1).all()
    assert not fitted.components[5:].any()


@pytest.mark.parametrize(("count", "size", "dimension"), [(8, 20, 8), (20, 7, 8), (1, 7, 1), (9, 7, 0)])
def test_too_few_vectors_raise(count, size, dimension):
    with pytest.raises(InputError, match=rf"more than {dimension} descriptors .*got {count} of {size};"):
        fit_whitening(np.random.default_rng(0).normal(size=(count, size)), dimension)


def test_a_descriptor_that_is_not_finite_teaches_nothing():
    sample = samples(40, 6, np.float32)
    broken = np.insert(sample, [0, 20], [[np.nan, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, np.inf]], axis=0)
    whitenings = (astuple(WhitenedSearch(3).fit(vectors).whitening) for vectors in (broken, sample))
    for from_broken, expected in zip(*whitenings, strict=True):
        np.testing.assert_array_equal(from_broken, expected)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e6])
@pytest.mark.parametrize("shape", [(9, 4), (4, 9)], ids=str)
def test_equal_vectors_raise(value, shape):
    with pytest.raises(InputError, match="that differ"):
        fit_whitening(np.full(shape, np.float32(value)), 2)


def test_a_flat_spectrum_is_solved_as_well():
    """Lanczos' method gains little there, or does not converge."""
    sample = np.random.default_rng(0).normal(size=(400, 120))
    fitted, (_, components) = fit_whitening(sample, 11), by_decomposition(sample, 11)
    np.testing.assert_allclose(fitted.components, components, atol=1e-9 * np.abs(components).max())
