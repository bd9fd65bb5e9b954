"""The protocol of choosing and reporting, against loops over queries."""

from dataclasses import replace

import numpy as np
import pytest

from mfvpr import InputError, Shortlist, frame_positives
from mfvpr.datasets import AllowedTruth, FrameTruth, LabelTruth, Positives, RadiusTruth
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation import best_setting, evaluation_protocol, halves, neighboring_settings
from mfvpr.evaluation.protocol import places_along_path

QUERIES, TOLERANCES, SETTINGS = 20, (0, 1, 3), 4
TRUTH = FrameTruth(tuple((row,) for row in range(QUERIES)), QUERIES)


@pytest.fixture
def rows():
    """Rankings `[V, S, Q, depth]`, not far from the truth; some end early."""
    rng = np.random.default_rng(0)
    rows = np.arange(QUERIES)[:, None] + rng.integers(-4, 5, (3, SETTINGS, QUERIES, 2))
    return np.where(rows < QUERIES, np.maximum(rows, -1), -1).astype(np.int32)


def recall_of(rows, queries, tolerance, k=1):
    """Recall of one ranking `[Q, depth]`, by a loop."""
    correct = [any(row >= 0 and abs(row - query) <= tolerance for row in rows[query][:k]) for query in queries]
    return sum(correct) / len(correct)


def test_recall_is_of_all_queries(rows):
    protocol = evaluation_protocol(TRUTH, TOLERANCES)
    assert protocol.names == []
    for k in (1, 2):
        expected = [[recall_of(ranking, range(QUERIES), width, k) for width in TOLERANCES] for ranking in rows[0]]
        np.testing.assert_allclose(protocol.recall(rows[0], k), expected)
    np.testing.assert_array_equal(protocol.tuning(rows), [protocol.recall(rows[0])])
    np.testing.assert_allclose(protocol.reported_hits(rows, [2]).mean(axis=1), protocol.recall(rows[0])[2])


@pytest.mark.parametrize(("split", "numbers"), [("both", [0, 1]), ("first_half", [0]), ("second_half", [1])])
def test_each_half_chooses_by_its_own_view_and_is_reported_on_by_the_other(rows, split, numbers):
    protocol, half = evaluation_protocol(TRUTH, TOLERANCES, split), QUERIES // 2
    assert protocol.names == [("first_half", "second_half")[number] for number in numbers]
    blocks = [range(half), range(half, QUERIES)]
    inner = [range(half - 2 * TOLERANCES[-1]), range(half + 2 * TOLERANCES[-1], QUERIES)]
    expected = [
        [[recall_of(ranking, inner[number], tolerance) for tolerance in TOLERANCES] for ranking in rows[view]]
        for view, number in enumerate(numbers, start=1)
    ]
    np.testing.assert_allclose(protocol.tuning(rows[: 1 + len(numbers)]), expected)
    chosen = [3, 1][: len(numbers)]
    parts = [
        [[bool(recall_of(rows[0][setting], [query], tolerance)) for query in blocks[1 - number]]
         for tolerance in TOLERANCES]
        for setting, number in zip(chosen, numbers, strict=True)
    ]  # fmt: skip
    along_the_path = np.concatenate(parts[::-1], axis=1)  # the first half is reported on by who chose on the second
    np.testing.assert_array_equal(protocol.reported_hits(rows, chosen), along_the_path)


def test_choosing_sees_no_candidate_of_a_reported_place():
    indices = np.tile(np.arange(-1, QUERIES, dtype=np.int32), (QUERIES, 1))
    shortlist = Shortlist(indices=indices, scores=np.zeros(indices.shape, np.float32), mask=indices >= 0)
    all_candidates, first, second = evaluation_protocol(TRUTH, TOLERANCES, "both").of(shortlist).views
    np.testing.assert_array_equal(all_candidates, indices >= 0)
    np.testing.assert_array_equal(first, (indices >= 0) & (indices < QUERIES // 2 - TOLERANCES[-1]))
    np.testing.assert_array_equal(second, indices >= QUERIES // 2 + TOLERANCES[-1])


def test_thresholds_ascend_and_the_middle_one_decides():
    protocol = evaluation_protocol(TRUTH, [3, 0, 1, 3])
    assert (protocol.thresholds, protocol.main, protocol.label(5, 1)) == ([0, 1, 3], 1, "R@5 ±1")
    np.testing.assert_array_equal(protocol.places.dense(), TRUTH.positives(3).dense())
    for thresholds, main in (([1], 0), ([0, 1], 1), ([0, 1, 2, 3], 2)):  # of two in the middle the larger
        assert (evaluation_protocol(TRUTH, thresholds).main, middle(thresholds)) == (main, thresholds[main])
    meters = evaluation_protocol(RadiusTruth(np.zeros((2, 2)), np.zeros((2, 2))), [25.0])
    assert meters.label(1, 25.0) == "R@1 25 m"


@pytest.mark.parametrize(
    ("thresholds", "split", "words"),
    [
        ([], None, "thresholds: expected at least one"),
        ([1], "half", r"split=half: .*None, first_half, second_half, both"),
        ([1, QUERIES], "both", r"split=both: no query .*half"),
    ],
)
def test_what_cannot_be_judged_is_said_before_anything_is_ranked(thresholds, split, words):
    with pytest.raises(InputError, match=words):
        evaluation_protocol(TRUTH, thresholds, split)


@pytest.mark.parametrize("split", [None, "both"])
def test_positions_are_reported_along_their_path_however_names_sort_them(split):
    """A street to the north whose names are sorted by easting, which is but noise."""
    rng = np.random.default_rng(0)
    north = rng.permutation(40).astype(float)
    positions = np.stack([rng.normal(0, 0.1, 40), 10 * north], axis=1)
    protocol = evaluation_protocol(RadiusTruth(positions, positions), [12.0], split)
    rows = np.where(north < 25, np.arange(40), -1).astype(np.int32)[None, None, :, None].repeat(3, axis=0)
    hits = protocol.reported_hits(rows, [0, 0] if split else [0])[0]
    changes = np.flatnonzero(np.diff(hits.astype(int)))
    assert hits.sum() == 25
    assert len(changes) == 1  # neighbors of the street are neighbors


def test_reported_sets_stay_apart_each_along_its_path():
    """Sets are joined behind the queries that are learned on, whatever places they share."""
    positions = np.stack([10.0 * np.random.default_rng(0).permutation(12), np.zeros(12)], axis=1)
    protocol = evaluation_protocol(RadiusTruth(positions, positions), [12.0])
    order = replace(protocol, reported_sets={"b": 4, "c": 5}).order
    for start, end in ((0, 3), (3, 7), (7, 12)):
        assert sorted(order[start:end]) == [*range(start, end)]
        along = positions[order[start:end], 0]
        assert along.tolist() in (sorted(along), sorted(along, reverse=True))


PLACES = 60
DRIVES = [*range(PLACES), *reversed(range(0, PLACES, 2))]  # there and back


def shown(seed, tolerance=2):
    """Images within the tolerance of each query's place, whose rows are in any order."""
    row = np.random.default_rng(seed).permutation(PLACES)
    return Positives.from_rows(
        [row[max(place - tolerance, 0) : place + tolerance + 1] for place in DRIVES], PLACES
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_neighbors_follow_whatever_the_rows_of_the_map_are(seed):
    places = places_along_path(shown(seed), "m")
    places = places if places[0] < places[PLACES - 1] else places.max() - places  # in the direction of the first drive
    assert np.abs(places - DRIVES).max() <= 2  # at the ends images are shown by few queries
    assert (np.diff(places[2 : PLACES - 2]) == 1).all()
    np.testing.assert_array_equal(places[PLACES:][::-1], places[:PLACES:2])


def test_frames_are_in_order_and_exact_images_in_that_of_the_first_queries():
    frames = Positives.from_rows([[place] for place in DRIVES], PLACES)
    np.testing.assert_array_equal(places_along_path(frames, "frames"), DRIVES)
    np.testing.assert_array_equal(places_along_path(shown(3, tolerance=0), "exact"), DRIVES)


@pytest.mark.parametrize("unit", ["frames", "m", "exact"])
def test_places_that_the_map_does_not_show_are_none(unit):
    places = places_along_path(Positives.from_rows([[], [3], [3], [], [1], [0], []], 5), unit)
    assert (places == -1).tolist() == [True, False, False, True, False, False, True]
    assert places[1] == places[2]
    assert len({*places[[1, 4, 5]].tolist()}) == 3
    for queries in (0, 2):
        assert places_along_path(Positives.from_rows([[]] * queries, 4), unit).tolist() == [-1] * queries


@pytest.mark.parametrize("tolerance", [0, 1, 3])
def test_halves_never_share_a_place(tolerance):
    places = np.arange(20)
    matrix = frame_positives(places, places, tolerance=tolerance)
    positives = Positives(matrix)
    for half in halves(positives):
        near = {place for query in half.report for place in range(query - tolerance, query + tolerance + 1)}
        assert set(np.flatnonzero(~half.allowed)) == near & set(range(20))
        assert all(set(np.flatnonzero(matrix[query])) & near == set() for query in half.tune)
        assert list(half.report) == list(range(half.report[0], half.report[-1] + 1))
    reported = np.concatenate([half.report for half in halves(positives)])
    assert sorted(reported) == list(range(20))
    first, second = halves(positives)
    assert len(first.tune) == len(second.tune) == 10 - 2 * tolerance


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
