"""Standardized descriptors against loops in float64, and the rules that choose them."""

import numpy as np
import pytest

from mfvpr.core.types import Shortlist
from mfvpr.datasets import FrameTruth, QuerySequence, RadiusTruth
from mfvpr.retrieval import Alternating, Retrieval, RetrievalResult, StandardizedSearch
from mfvpr.retrieval.retriever import fit_to_sequence, standardizations
from mfvpr.retrieval.standardization import PRIOR, GrowingDatabase, Moments, standardize

RNG = np.random.default_rng(0)
DATABASE = RNG.normal(1.0, 2.0, (30, 12)).astype(np.float32)
QUERIES = (DATABASE[5:14] * 0.5 + 3.0 + RNG.normal(0, 0.05, (9, 12))).astype(np.float32)  # another season


def unit(rows):
    return np.array([row / np.sqrt((row**2).sum()) for row in rows])


def oracle(queries, database, rule):
    """The rules of the module, written as loops."""
    queries, database = queries.astype(float), database.astype(float)
    mean = sum(database) / len(database)
    if rule == "database":
        return unit(queries - mean), unit(database - mean)
    square = sum(row**2 for row in database) / len(database)
    of_queries = []
    for number, query in enumerate(queries):
        drive = queries if rule == "drive" else queries[: number + 1]
        drive_mean = (PRIOR * mean + sum(drive)) / (PRIOR + len(drive))
        drive_square = (PRIOR * square + sum(row**2 for row in drive)) / (PRIOR + len(drive))
        of_queries.append((query - drive_mean) / np.sqrt(drive_square - drive_mean**2))
    return unit(of_queries), unit((database - mean) / np.sqrt(square - mean**2))


@pytest.mark.parametrize("rule", ["drive", "running", "database"])
def test_descriptors_are_standardized_as_by_loops(rule):
    for values, expected in zip(standardize(QUERIES, DATABASE, rule), oracle(QUERIES, DATABASE, rule), strict=True):
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, expected, atol=1e-6)


def test_a_change_that_all_queries_share_costs_no_candidates():
    day = RNG.normal(size=(200, 24)).astype(np.float32)
    night = 0.5 * day + 4 * RNG.normal(size=(1, 24)).astype(np.float32)
    rules = "none", "database", "drive", "running"
    first = {rule: StandardizedSearch(rule).shortlist(night, day, 1).indices[:, 0] for rule in rules}
    correct = {rule: (rows == np.arange(200)).mean() for rule, rows in first.items()}
    assert correct["none"] < 0.1
    assert correct["drive"] > 0.9
    assert correct["running"] > 0.6  # the first queries have no drive to learn from


def test_running_statistics_do_not_look_ahead():
    changed = np.concatenate([QUERIES[:4], RNG.normal(size=(5, 12)).astype(np.float32)])
    first, second = (standardize(queries, DATABASE, "running")[0][:4] for queries in (QUERIES, changed))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("rule", ["drive", "running", "database"])
def test_unusable_descriptors_change_no_others(rule):
    bad = np.full((1, 12), np.nan, np.float32)
    queries, database = np.concatenate([bad, QUERIES]), np.concatenate([DATABASE, bad])
    for values, expected in zip(
        (standardize(queries, database, rule)[0][1:], standardize(queries, database, rule)[1][:-1]),
        standardize(QUERIES, DATABASE, rule),
        strict=True,
    ):
        np.testing.assert_allclose(values, expected, atol=1e-6)
    shortlist = StandardizedSearch(rule).shortlist(queries, database, 31)
    assert not shortlist.mask[0].any()
    assert 30 not in shortlist.indices
    assert not StandardizedSearch(rule).shortlist(QUERIES, np.repeat(bad, 3, axis=0), 2).mask.any()


@pytest.mark.parametrize("rule", ["drive", "running", "database"])
def test_equal_descriptors_are_no_reason_to_fail(rule):
    equal = np.ones((4, 12), np.float32)
    assert np.isfinite(StandardizedSearch(rule).shortlist(equal, equal, 2).scores).all()


@pytest.mark.parametrize(
    ("truth", "rule"),
    [
        (FrameTruth(((0,),), 1), "drive"),
        (FrameTruth(((0,),), 1, widened=False), "database"),
        (RadiusTruth(np.zeros((1, 2)), np.zeros((1, 2))), "database"),
        (None, "database"),
    ],
)
def test_auto_is_the_drive_where_frames_count(truth, rule):
    sequence = QuerySequence("walk", None, truth)  # pyright: ignore[reportArgumentType]
    both = Alternating(Retrieval(None, StandardizedSearch("auto")), Retrieval(None, StandardizedSearch("running")))
    fitted = fit_to_sequence(both, sequence)
    assert [each.search.standardize for each in (fitted.first, fitted.second)] == [rule, "running"]
    assert standardizations(both, [sequence]) == {rule, "running"}


@pytest.mark.parametrize("size", [3, 15, 16, 17, 30])
def test_a_growing_database_is_standardized_as_one_that_has_all_rows(size):
    """For single images, and for a drive image by image; the statistics are those of the rows that a step counts."""
    step = 1 if size < 16 else 2
    basis, rows = DATABASE[: size // step * step], DATABASE[:size]
    growing, drive = GrowingDatabase(), None
    for smaller in range(1, size):  # as the map grew
        growing.standardize(DATABASE[:smaller], QUERIES[:1], None)
    for number, query in enumerate(QUERIES):
        drive = Moments.of(query[None]).joined(drive)
        [got], of_rows = growing.standardize(rows, query[None], drive)
        expected, of_basis = standardize(QUERIES[: number + 1], basis, "running")
        np.testing.assert_allclose(got, expected[-1], atol=1e-6)
        np.testing.assert_allclose(of_rows[: len(basis)], of_basis, atol=1e-6)
        np.testing.assert_allclose(of_rows[len(basis) :], Moments.of(basis).standardize(rows[len(basis) :]), atol=1e-6)
    [got], of_rows = growing.standardize(rows, QUERIES[:1], None)
    expected, of_basis = standardize(QUERIES[:1], basis, "database")
    np.testing.assert_allclose(got, expected[0], atol=1e-6)
    np.testing.assert_allclose(of_rows[: len(basis)], of_basis, atol=1e-6)


class Chosen:
    """A retrieval that knows its candidates."""

    def __init__(self, rows, bad_queries=()):
        self.rows, self.bad = np.array(rows, np.int32), dict.fromkeys(bad_queries, "unreadable")

    def shortlist(self, sequence, database, num_candidates, cache):
        rows = self.rows[:, :num_candidates]
        return RetrievalResult(Shortlist(rows, np.ones(rows.shape, np.float32), rows >= 0), self.bad, {7: "gray"})


def test_two_retrievals_alternate():
    first = Chosen([[0, 1, 2, 3], [4, 5, -1, -1], [-1, -1, -1, -1]], bad_queries=[1, 2])
    second = Chosen([[1, 6, 0, 2], [5, 4, 3, -1], [-1, -1, -1, -1]], bad_queries=[2])
    sequence = QuerySequence("walk", range(3), None)  # pyright: ignore[reportArgumentType]
    result = Alternating(first, second).shortlist(sequence, None, 4, None)  # pyright: ignore[reportArgumentType]
    shortlist = result.candidates
    np.testing.assert_array_equal(shortlist.indices, [[0, 1, 6, 2], [4, 5, 3, -1], [-1, -1, -1, -1]])
    np.testing.assert_array_equal(shortlist.mask, shortlist.indices >= 0)
    np.testing.assert_array_equal(shortlist.scores, [[1, 0.75, 0.5, 0.25], [1, 0.75, 0.5, 0], [0, 0, 0, 0]])
    assert (result.bad_queries, result.bad_database) == ({2: "unreadable"}, {7: "gray"})
