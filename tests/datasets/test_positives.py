"""Positives as rows per query are equal to a matrix `[Q, N]` bool."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mfvpr import InputError
from mfvpr.datasets import Positives

sizes = st.tuples(st.integers(0, 7), st.integers(0, 9))
matrices = sizes.flatmap(lambda shape: arrays(bool, shape))
pairs = sizes.flatmap(lambda shape: st.tuples(arrays(bool, shape), arrays(bool, shape)))
seeds = st.integers(0, 2**32 - 1)


def check_same(got, matrix):
    """Every attribute is that of loops over the matrix: equal positives have one form, which is hashed."""
    rows = [row for line in matrix.tolist() for row, is_correct in enumerate(line) if is_correct]
    assert (got.rows.dtype, got.offsets.dtype) == (np.int32, np.int64)
    assert (got.rows.tolist(), got.num_database, len(got)) == (rows, matrix.shape[1], len(matrix))
    assert got.offsets.tolist() == [sum(map(sum, matrix.tolist()[:query])) for query in range(len(matrix) + 1)]


@given(matrices)
def test_they_are_the_matrix(matrix):
    got = Positives(matrix)
    check_same(got, matrix)
    np.testing.assert_array_equal(got.dense(), matrix)
    np.testing.assert_array_equal(got.counts, matrix.sum(axis=1))
    for query in range(-len(matrix), len(matrix)):
        np.testing.assert_array_equal(got.of(query), np.flatnonzero(matrix[query]))
    for beyond in (len(matrix), -len(matrix) - 1):
        with pytest.raises(IndexError):
            got.of(beyond)


@given(matrices, seeds)
def test_rows_come_in_any_order_and_any_number_of_times(matrix, seed):
    rng = np.random.default_rng(seed)
    rows = [np.repeat(line.nonzero()[0], rng.integers(1, 3)) for line in matrix]
    shuffled = [rng.permutation(query_rows).tolist() for query_rows in rows]
    check_same(Positives.from_rows(shuffled, matrix.shape[1]), matrix)
    check_same(Positives.from_rows(map(np.uint64, shuffled), matrix.shape[1]), matrix)


@given(matrices, seeds)
def test_of_some_queries(matrix, seed):
    rng, got = np.random.default_rng(seed), Positives(matrix)
    mask = rng.random(len(matrix)) < 0.5
    numbers = rng.integers(0, max(len(matrix), 1), 9 * bool(len(matrix)))
    for queries in (mask, numbers, slice(1, 4), slice(None, None, -2), []):
        chosen = matrix[queries] if len(np.shape(queries)) == 0 or len(queries) else matrix[:0]
        check_same(got.take(queries), chosen)
        np.testing.assert_array_equal(got.dense(queries), chosen)


@given(pairs)
def test_union_and_difference(pair):
    first, second = map(Positives, pair)
    check_same(first | second, pair[0] | pair[1])
    check_same(first - second, pair[0] & ~pair[1])


@given(matrices, seeds, st.sampled_from([(), (1,), (2, 3), (0,)]))
def test_rankings_are_looked_up(matrix, seed, several):
    rng = np.random.default_rng(seed)
    rows = rng.integers(-2, matrix.shape[1], (*several, len(matrix), 4)).astype(rng.choice(["i4", "i8"]))
    query = np.arange(len(matrix))[:, None]
    expected = matrix[query, np.maximum(rows, 0)] & (rows >= 0) if matrix.size else np.zeros(rows.shape, bool)
    np.testing.assert_array_equal(Positives(matrix).contains(rows), expected)


@pytest.mark.parametrize("rows", [np.zeros((3, 1), int), np.zeros(2, int), np.array([[0], [4]]), np.zeros((2, 1))])
def test_rankings_of_other_data_are_errors(rows):
    with pytest.raises(InputError, match=r"rows: expected whole numbers \[..., 2 queries, k\] below 4, got "):
        Positives.from_rows([[0], [0, 1]], 4).contains(rows)


def test_values_that_do_not_fit_are_errors():
    got = Positives.from_rows([[0], [0, 1]], 4)
    for rows in ([[4]], [[0], [-1]], [[2**32]], [[0.5]], np.eye(2, dtype=bool)):
        with pytest.raises(InputError, match=r"positives: .*4 images, got .*takes matrices"):
            Positives.from_rows(rows, 4)
    with pytest.raises(ValueError, match="inconsistent shape"):
        got | Positives.from_rows([[0], [0]], 5)
    with pytest.raises(InputError, match="expected a matrix"):
        Positives(np.ones(3, bool))
