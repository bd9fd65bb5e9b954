"""The protocol of choosing and reporting, against loops over queries."""

import numpy as np
import pytest

from mfvpr import InputError, Shortlist
from mfvpr.datasets import FrameTruth, RadiusTruth
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation import evaluation_protocol

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
    np.testing.assert_allclose(protocol.tuning(rows), expected)
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


def test_fingerprints_tell_what_is_right_apart():
    shifted = FrameTruth(tuple(((row + 1) % QUERIES,) for row in range(QUERIES)), QUERIES)
    protocols = [
        evaluation_protocol(TRUTH, TOLERANCES),
        evaluation_protocol(TRUTH, (0, 1, 2)),
        evaluation_protocol(shifted, TOLERANCES),
        evaluation_protocol(TRUTH, (1, 3)),
    ]
    assert len({protocol.fingerprint for protocol in protocols}) == 4
    assert evaluation_protocol(TRUTH, TOLERANCES, "both").fingerprint == protocols[0].fingerprint


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
