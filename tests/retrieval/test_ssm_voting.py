"""Votes of windows against loops over all of them."""

import math

import numpy as np
import pytest

from mfvpr.datasets import Positives
from mfvpr.retrieval import retriever
from mfvpr.retrieval.retriever import vote


def by_loops(queries, database, num_candidates, excluded=()):
    """Candidates and votes of each query, as lists: the nearest windows by distance, the first of equal ones."""
    listed = []
    for number, query in enumerate(queries):
        hidden = excluded[number] if excluded else ()
        usable = [row for row, image in enumerate(database) if row not in hidden and np.isfinite(image).all()]
        votes = dict.fromkeys(usable, 0)
        for window in query if np.isfinite(query).all() else ():
            distances = [(math.dist(window, other), row) for row in usable for other in database[row]]
            for _, row in sorted(distances, key=lambda pair: pair[0])[:num_candidates]:
                votes[row] += 1
        order = sorted(usable, key=lambda row: (-votes[row], row)) if np.isfinite(query).all() else []
        listed.append([(row, votes[row]) for row in order[:num_candidates]])
    return listed


def assert_lists(shortlist, expected, num_candidates):
    assert shortlist.indices.shape == (len(expected), num_candidates)
    for indices, scores, mask, pairs in zip(shortlist.indices, shortlist.scores, shortlist.mask, expected, strict=True):
        assert list(zip(indices[mask].tolist(), scores[mask].tolist(), strict=True)) == pairs
        assert mask.sum() == len(pairs)
        assert (indices[~mask] == -1).all()
        assert (scores[~mask] == 0).all()


def windows(seed, images, per_image=4, dimension=5):
    return np.random.default_rng([seed, images]).normal(size=(images, per_image, dimension)).astype(np.float32)


@pytest.mark.parametrize("num_candidates", [1, 3, 9, 12])
def test_agrees_with_the_loop(num_candidates):
    queries, database = windows(0, 7), windows(0, 9)
    database[4, 1, 0], queries[2, 1, 0] = np.nan, np.inf
    got = vote(queries, database, num_candidates)
    assert_lists(got, by_loops(queries, database, num_candidates), num_candidates)


def test_excluded_images_neither_get_votes_nor_fill_up(monkeypatch):
    monkeypatch.setattr(retriever, "QUERIES", 2)
    queries, database = windows(1, 5), windows(1, 8)
    excluded = [[0, 1, 2], [], [7], [*range(8)], [3]]
    got = vote(queries, database, 8, excluded=Positives.from_rows(excluded, 8))
    assert_lists(got, by_loops(queries, database, 8, excluded), 8)
    assert not got.mask[3].any()


def test_equal_votes_go_by_row_and_equal_windows_by_image():
    database = np.zeros((3, 2, 4), np.float32)
    got = vote(np.ones((1, 2, 4), np.float32), database, 3)
    np.testing.assert_array_equal(got.indices, [[0, 1, 2]])
    np.testing.assert_array_equal(got.scores, [[4, 2, 0]])


def test_a_database_of_one_image():
    for num_candidates in (1, 5):
        got = vote(windows(3, 2), windows(3, 1), num_candidates)
        assert_lists(got, by_loops(windows(3, 2), windows(3, 1), num_candidates), num_candidates)
