"""Nearest neighbors in blocks, against the sort of all: sizes that come out even and that do not, ties, nothing."""

import jax
import numpy as np
import pytest

from mfvpr.matching.similarity import nearest, nearest_two

pytestmark = [pytest.mark.optimized, pytest.mark.thorough]

nearest_of = jax.jit(nearest, static_argnames="axis")
two_of = jax.jit(nearest_two)


def make(rows, columns, kind):
    rng = np.random.default_rng([rows, columns, len(kind)])
    values = rng.normal(size=(rows, columns)).astype(np.float32)
    if kind == "ties":
        values = rng.integers(0, 3, (rows, columns)).astype(np.float32)
    if kind == "peaks":  # one in every row, and many second ones that are equal
        values = rng.integers(0, 2, (rows, columns)).astype(np.float32)
        values[np.arange(rows), rng.integers(0, columns, rows)] = 2
    if kind == "holes":
        values[rng.random((rows, columns)) < 0.8] = -np.inf
    return values


def assert_neighbors(index, largest, values, place):
    """As of every row by descending value, the first of equals first; -inf where there is no neighbor."""
    padded = np.concatenate([values, np.full((len(values), 2), -np.inf, np.float32)], axis=1)
    order = np.argsort(-padded, axis=1, kind="stable")[:, place]
    expected = padded[np.arange(len(values)), order]
    np.testing.assert_array_equal(largest, expected)
    has_neighbor = expected > -np.inf
    np.testing.assert_array_equal(np.asarray(index)[has_neighbor], order[has_neighbor])
    assert place or not np.asarray(index)[~has_neighbor].any()


@pytest.mark.parametrize("kind", ["random", "ties", "peaks", "holes"])
@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (1, 1), (3, 2), (7, 31), (40, 64), (65, 97), (60, 8)])
def test_neighbors_are_those_of_a_stable_sort(rows, columns, kind):
    values = make(rows, columns, kind)
    assert_neighbors(*nearest_of(values, 1), values, 0)
    assert_neighbors(*nearest_of(values, 0), values.T, 0)
    for place, neighbors in enumerate(two_of(values)):
        assert_neighbors(*neighbors, values, place)
