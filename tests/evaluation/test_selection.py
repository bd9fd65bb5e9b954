"""Which setting, on which queries: explicit small cases."""

import numpy as np
import pytest

from mfvpr import frame_positives
from mfvpr.datasets import AllowedTruth, FrameTruth, LabelTruth, Positives
from mfvpr.evaluation import best_setting, halves, neighboring_settings
from mfvpr.evaluation.protocol import halves_of_map


@pytest.mark.parametrize("tolerance", [0, 1, 3])
def test_halves_never_share_a_place(tolerance):
    places = np.arange(20)
    matrix = frame_positives(places, places, tolerance=tolerance)
    positives = Positives.from_matrix(matrix)
    for half in halves(positives):
        near = {place for query in half.report for place in range(query - tolerance, query + tolerance + 1)}
        assert set(np.flatnonzero(~half.allowed)) == near & set(range(20))
        assert all(set(np.flatnonzero(matrix[query])) & near == set() for query in half.tune)
        assert list(half.report) == list(range(half.report[0], half.report[-1] + 1))
    reported = np.concatenate([half.report for half in halves(positives)])
    assert sorted(reported) == list(range(20))
    first, second = halves(positives)
    assert len(first.tune) == len(second.tune) == 10 - 2 * tolerance


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_queries_without_a_place_are_in_both_halves_of_a_map(share):
    """One drive there, one back, and one elsewhere: neither half has all that is nowhere, or all that is somewhere."""
    rng, drive = np.random.default_rng(0), np.arange(100)
    there = np.where(rng.random(100) < share, -1, drive)
    parts = [Positives.from_matrix(frame_positives(places, drive, tolerance=2))
             for places in (there, there[::-1], np.full(50, -1))]  # fmt: skip
    nowhere = np.concatenate([there, there[::-1], np.full(50, -1)]) < 0
    both = halves_of_map(parts, "frames")
    assert sorted(np.concatenate([half.report for half in both])) == list(range(250))
    for half in both:
        for side in (half.tune, half.report):
            assert abs(nowhere[side].sum() - nowhere.sum() / 2) <= 2
            assert abs((~nowhere[side]).sum() - (~nowhere).sum() / 2) <= 0.1 * (~nowhere).sum() + 8


def test_halves_of_a_map_where_most_queries_wait_at_its_end():
    waiting_last = np.r_[np.arange(0, 60, 3), np.full(40, 59)]
    for places, expected in ((waiting_last, [2 * 40, 2 * 20]), (59 - waiting_last, [2 * 20, 2 * 40])):
        parts = [Positives.from_matrix(frame_positives(places, np.arange(60), tolerance=1))] * 2
        assert [len(half.report) for half in halves_of_map(parts, "frames")] == expected
    without_places = halves_of_map([Positives.from_rows([[]] * 4, 3)] * 2, "m")
    assert [len(half.report) for half in without_places] == [4, 4]


def test_neighbors_are_one_step_along_one_axis():
    axes = {"sigma": [1, 2, 3], "weight": ["fs", "dmf"]}  # numbers: 0 1 / 2 3 / 4 5
    assert neighboring_settings(axes, 2) == [0, 4, 3]
    assert neighboring_settings(axes, 5) == [3, 4]
    assert neighboring_settings({"sigma": [1]}, 0) == []


def test_equals_are_told_apart_by_their_neighbors():
    axes = {"sigma": [1, 2, 3, 4, 5]}
    assert best_setting(np.array([0.9, 0.1, 0.8, 0.9, 0.8]), axes) == 3
    assert best_setting(np.array([0.9, 0.1, 0.8, 0.9, 0.8])) == 0
    assert best_setting(np.array([0.2, 0.1, 0.8, 0.4, 0.7]), axes) == 2
    assert best_setting(np.array([0.8, 0.9, 0.0, 0.7, 0.9, 0.7]), {"sigma": range(6)}) == 4  # on average


def test_a_query_that_is_a_database_image_is_seen_where_it_is_reported():
    """A place that is passed twice, in one sequence: what may not prediction a query still shows its place."""
    labels = np.r_[np.arange(50), np.arange(50)]
    itself = FrameTruth(tuple((row,) for row in range(100)), 100)
    truth = AllowedTruth(LabelTruth(labels, labels), itself.positives(3))
    assert (truth.positives(0).counts == 1).all()
    for half in halves(truth.shows_place(0)):
        assert len(half.tune) == 0
