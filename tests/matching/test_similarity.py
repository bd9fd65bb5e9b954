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


def ordered(values):
    """Columns of every row by descending value, the first of equals first."""
    return np.argsort(-values, axis=1, kind="stable")


@pytest.mark.parametrize("kind", ["random", "ties", "holes"])
@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (1, 1), (3, 2), (7, 31), (40, 64), (65, 97), (60, 8)])
def test_neighbors_are_those_of_a_stable_sort(rows, columns, kind):
    values = make(rows, columns, kind)
    for axis, along in ((1, values), (0, values.T)):
        index, largest = nearest_of(values, axis)
        assert index.shape == largest.shape == (len(along),)
        if along.shape[1] == 0:
            assert (np.asarray(index) == 0).all()
            assert (np.asarray(largest) == -np.inf).all()
            continue
        has_neighbor = np.asarray(largest) > -np.inf
        np.testing.assert_array_equal(largest, along.max(axis=1))
        np.testing.assert_array_equal(np.asarray(index)[has_neighbor], ordered(along)[has_neighbor, 0])
        assert (np.asarray(index)[~has_neighbor] == 0).all()


@pytest.mark.parametrize("kind", ["random", "ties", "peaks", "holes"])
@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (1, 1), (3, 2), (7, 31), (40, 64), (65, 97), (60, 8)])
def test_the_two_nearest_are_the_first_of_a_stable_sort(rows, columns, kind):
    values = make(rows, columns, kind)
    for place, (index, largest) in enumerate(two_of(values)):
        if place == columns:
            assert (np.asarray(largest) == -np.inf).all()
            continue
        expected = np.take_along_axis(values, ordered(values), 1)[:, place]
        np.testing.assert_array_equal(largest, expected)
        has_neighbor = expected > -np.inf
        np.testing.assert_array_equal(np.asarray(index)[has_neighbor], ordered(values)[has_neighbor, place])
