"""Nearest neighbors in blocks, against the sort of all: sizes that come out even and that do not, ties, nothing."""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from mfvpr.core import nearest as nearest_module
from mfvpr.core.checked import count_from
from mfvpr.core.nearest import largest_of, lines_of, without

pytestmark = [pytest.mark.optimized, pytest.mark.thorough]


@partial(jax.jit, static_argnames="axis")
def two_of(values, axis):
    """The nearest and the second nearest of all lines, and the number of entries that are at least as near."""
    lines = lines_of(values, axis)
    first = largest_of(lines)
    rest = without(lines, first.index)
    second = largest_of(rest)
    return first, second, count_from(lines, first, first.similarity), count_from(lines, first, second.similarity)


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


@pytest.mark.parametrize("kind", ["random", "ties", "holes"])
def test_the_method_of_accelerators_finds_the_same_neighbors(kind, monkeypatch):
    values = make(40, 64, kind)
    for axis in (0, 1):
        *on_cpu, _, _ = two_of(values, axis)
        with monkeypatch.context() as patched:
            patched.setattr(nearest_module, "device_of", lambda _: SimpleNamespace(platform="gpu"))
            *elsewhere, _, _ = two_of.__wrapped__(values, axis)
        jax.tree.map(np.testing.assert_array_equal, on_cpu, elsewhere)


@pytest.mark.parametrize("kind", ["random", "ties", "peaks", "holes"])
@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (1, 1), (3, 2), (7, 31), (40, 64), (65, 97), (60, 8)])
def test_neighbors_are_those_of_a_stable_sort(rows, columns, kind):
    values = make(rows, columns, kind)
    for axis, lines in ((1, values), (0, values.T)):
        *neighbors, first, second = two_of(values, axis)
        for place, neighbor in enumerate(neighbors):
            assert_neighbors(*neighbor, lines, place)
        largest, next_largest = (np.asarray(side.similarity)[:, None] for side in neighbors)
        at_first, at_second = (lines >= largest).sum(1), (lines >= next_largest).sum(1)
        has_neighbor = next_largest[:, 0] > -np.inf
        np.testing.assert_array_equal((first == 1)[has_neighbor], (at_first == 1)[has_neighbor])
        assert (np.asarray(second)[has_neighbor] >= 2).all()
        assert (np.asarray(second) <= at_second)[has_neighbor].all()
