"""Shortlists, positives and recall."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import frame_positives, radius_positives, recall_at_k, retrieve
from mfvpr.datasets import Positives
from mfvpr.retrieval import search as retrieval
from mfvpr.retrieval.search import EXACT
from mfvpr.utils import InputError
from tests import oracles
from tests.builders import unit
from tests.shapes import unchecked_shapes


def test_shortlist_is_the_exact_order():
    rng = np.random.default_rng(0)
    queries, database = unit(rng.normal(size=(5, 8))), unit(rng.normal(size=(30, 8)))
    shortlist = retrieve(queries, database, num_candidates=7)
    similarity = queries.astype(np.float64) @ database.T.astype(np.float64)
    np.testing.assert_array_equal(shortlist.indices, np.argsort(-similarity, axis=1, kind="stable")[:, :7])
    np.testing.assert_allclose(shortlist.scores, -np.sort(-similarity, axis=1)[:, :7], atol=1e-6)
    assert shortlist.mask.all()


def test_a_descriptor_that_is_not_finite_never_appears():
    database = np.eye(3, dtype=np.float32)
    database[1] = np.nan
    queries = np.array([[0, 0, 1], [np.nan, 0, 0]], np.float32)
    shortlist = retrieve(queries, database, num_candidates=3)
    np.testing.assert_array_equal(shortlist.indices, [[2, 0, -1], [-1, -1, -1]])
    masked = retrieve(queries[:1], database, num_candidates=3, mask=np.array([True, True, False]))
    np.testing.assert_array_equal(masked.indices, [[0, -1, -1]])


@pytest.mark.parametrize("rows", [2, 9])
def test_the_first_of_equal_rows_wins_whatever_is_searched_at_a_time(rows, monkeypatch):
    monkeypatch.setattr(retrieval, "ROWS", rows)
    queries = np.eye(2, dtype=np.float32)
    shortlist = EXACT.shortlist(queries, queries[[0, 1, 0, 0, 1, 0]], 3)
    np.testing.assert_array_equal(shortlist.indices, [[0, 2, 3], [1, 4, 0]])


@pytest.mark.parametrize("columns", [3, 256, 1000, 1024])
@pytest.mark.parametrize("kind", ["random", "ties", "few"])
def test_the_largest_in_blocks_are_the_largest(columns, kind):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(6, columns)) if kind == "random" else rng.integers(0, 3, (6, columns)).astype(float)
    if kind == "few":
        values[rng.random((6, columns)) < 0.99] = -np.inf
    for depth in (1, 3):
        expected = np.argsort(-values, axis=1, kind="stable")[:, :depth]
        scores, indices = retrieval._largest_in_blocks(values.astype(np.float32), depth)
        np.testing.assert_array_equal(indices, expected)
        np.testing.assert_array_equal(scores, np.take_along_axis(values.astype(np.float32), expected, axis=1))


@pytest.mark.optimized
@pytest.mark.parametrize("num_database", [1, 100])
def test_a_query_has_the_same_bits_alone_and_in_company_whatever_the_memory(num_database, monkeypatch):
    rng = np.random.default_rng(0)
    queries, database = unit(rng.normal(size=(5, 130))), unit(rng.normal(size=(num_database, 130)))
    together = retrieve(queries, database, num_candidates=9)
    np.testing.assert_array_equal(retrieve(queries[4:], database, num_candidates=9).scores, together.scores[4:])
    monkeypatch.setattr(retrieval, "SHARE", 1)
    for memory in (10**9, 0, 8 * 4 * num_database):  # parts of 5; of 2, 2 and 1; of 3 and 2
        monkeypatch.setattr(retrieval, "free_bytes", lambda _, memory=memory: memory)
        shortlist = EXACT.shortlist(queries, database, 9)
        np.testing.assert_array_equal(shortlist.indices, together.indices)
        np.testing.assert_array_equal(shortlist.scores, together.scores)


@pytest.mark.parametrize("rows", [1, 7, 30])
def test_parts_of_the_database_change_nothing(rows, monkeypatch):
    rng = np.random.default_rng(3)
    queries, database = unit(rng.normal(size=(11, 8))), unit(rng.normal(size=(30, 8)))
    excluded = Positives.from_rows([rng.permutation(30)[: row % 5] for row in range(11)], 30)
    monkeypatch.setattr(retrieval, "SHARE", 1)
    monkeypatch.setattr(retrieval, "free_bytes", lambda _: 8 * 4 * rows)  # parts of 4 queries
    expected = retrieve(queries, database, num_candidates=6, mask=~excluded.dense(slice(0, 11)))
    monkeypatch.setattr(retrieval, "ROWS", rows)
    shortlist = EXACT.shortlist(queries, database, 6, excluded=excluded)
    np.testing.assert_array_equal(shortlist.indices, expected.indices)
    np.testing.assert_allclose(shortlist.scores, expected.scores, atol=1e-6)


@pytest.mark.parametrize("usable", [[0, 7], [4], []])
def test_candidates_that_no_part_of_the_database_has_are_minus_1(usable, monkeypatch):
    monkeypatch.setattr(retrieval, "ROWS", 3)
    database = np.full((8, 4), np.nan, np.float32)
    database[usable] = 0.5
    shortlist = EXACT.shortlist(np.full((2, 4), 0.5, np.float32), database, 5)
    expected = [*usable, *[-1] * (5 - len(usable))]
    assert shortlist.indices.tolist() == [expected] * 2
    assert shortlist.mask.tolist() == [[row >= 0 for row in expected]] * 2


@given(st.lists(st.integers(-1, 9), min_size=1, max_size=8), st.integers(1, 10), st.integers(0, 5))
def test_frame_positives(queries, num_database, tolerance):
    got = frame_positives(np.array(queries), np.arange(num_database), tolerance=tolerance)
    expected = oracles.frame_positives(queries, range(num_database), tolerance)
    expected[np.array(queries) < 0] = False  # unknown place
    np.testing.assert_array_equal(got, expected)


def test_radius_is_inclusive_and_keeps_centimeters_at_utm_size():
    database = np.array([[4_400_000.00, 500_000.00], [4_400_025.00, 500_000.00], [4_400_025.02, 500_000.00]])
    np.testing.assert_array_equal(radius_positives(database[:1], database), [[True, True, False]])
    rng = np.random.default_rng(1)
    queries, places = rng.uniform(0, 100, (20, 2)), rng.uniform(0, 100, (30, 2))
    expected = oracles.radius_positives(queries, places, 25.0)
    np.testing.assert_array_equal(radius_positives(queries, places), expected)
    with unchecked_shapes(), pytest.raises(InputError, match=r"query_xy: expected positions \[2, 2\]"):
        radius_positives(np.ones((2, 3)), np.ones((2, 3)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_recall(seed, depth):
    rng = np.random.default_rng(seed)
    order = np.stack([rng.permutation(9)[:depth] for _ in range(5)])
    order[rng.random(order.shape) < 0.2] = -1
    positives = rng.random((5, 9)) < 0.2
    ks = [1, 2, 5, 100]
    with pytest.raises(InputError, match=r"order: expected database rows \[Q, C\].*, got \[2, "):
        recall_at_k(np.stack([order, order]), positives, ks)
    expected = oracles.recall_at_k(order, positives, ks)
    np.testing.assert_allclose(recall_at_k(order, positives, ks), expected)
    np.testing.assert_array_equal(recall_at_k(order, Positives(positives), ks), expected)
    for wrong in (np.argsort(positives, axis=1)[:, :3] + 1, np.where(positives, 0.5, np.nan)):
        with unchecked_shapes(), pytest.raises(InputError, match=r"^positives: expected True and False"):
            recall_at_k(order, wrong, ks)


def test_descriptors_of_different_lengths_and_masks_of_another_shape_are_refused():
    vectors = np.eye(5, dtype=np.float32)
    with unchecked_shapes(), pytest.raises(InputError, match=r"expected \[Q, D\] and \[M, D\] of the database, got"):
        retrieve(np.eye(2, dtype=np.float32), vectors, num_candidates=1)
    for shape in ((1,), (4, 1), (5, 4)):
        with unchecked_shapes(), pytest.raises(InputError, match=r"^mask: expected shape \(5,\) or \(4, 5\), got"):
            retrieve(vectors[:4], vectors, num_candidates=2, mask=np.ones(shape, bool))
