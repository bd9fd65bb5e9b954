"""Routes, against the filter of an evaluation and what is known of easy drives."""

import math

import numpy as np
import pytest

from mfvpr.evaluation.drives import Evidence, follow
from mfvpr.evaluation.rankings import Ranked
from mfvpr.localization import Alternative, Drive, Prediction, Route, route


def prediction(scores, p=None):
    """A prediction with scores by row."""
    alternatives = tuple(Alternative(row, str(row), row, score) for row, score in scores.items())
    return Prediction(alternatives=alternatives, confidence=p)


def sharp(row, p=1.0):
    """A prediction that is sure of one row."""
    return prediction({row: 3.0}, p)


@pytest.mark.parametrize("advance", [1.3, None])
def test_it_is_the_causal_filter_of_an_evaluation(advance):
    rng, drive = np.random.default_rng(0), Drive(advance, 0.8, 0.05)
    there, drive_route = np.ones(40, bool), Route(drive, warn=lambda _: None)
    there[[5, 17]] = False
    rows = np.stack([rng.choice(np.flatnonzero(there), 8, replace=False) for _ in range(12)])
    scores = rng.exponential(size=rows.shape)
    followed = follow(Evidence.of(Ranked(rows, scores)), drive, there)
    for image, (of_image, its_scores) in enumerate(zip(rows.tolist(), scores.tolist(), strict=True)):
        located = drive_route(prediction(dict(zip(of_image, its_scores, strict=True))), there)
        belief = drive_route.belief[:40][there]
        assert belief.max() == pytest.approx(followed.p[image, 0], rel=1e-4)  # rows may be level
        assert (located.row is None) == (located.off >= 0.9)
        assert located.off == pytest.approx(float(followed.off[image]), rel=1e-4)
        np.testing.assert_allclose(drive_route.belief[followed.rows[image]], followed.p[image], rtol=1e-3)
        by_row = np.where(there, drive_route.belief[:40], 0)
        near = by_row[np.abs(np.arange(40) - np.argmax(by_row)) <= 2].sum()
        assert located.p == pytest.approx(near * (1 - located.off), rel=1e-4)


@pytest.mark.parametrize("advance", [0, 1, 4, -2])
def test_the_speed_is_learned_also_where_it_changes(advance):
    there, drive_route = np.ones(200, bool), Route(Drive())
    rows = [100 + advance * turn for turn in range(20)]
    rows += [rows[-1] - turn for turn in range(1, 20)]  # then backwards
    located = [drive_route(sharp(row, 0.6), there) for row in rows]
    far = [turn for turn, (each, row) in enumerate(zip(located, rows, strict=True)) if abs(each.row - row) > 1]
    assert {*far} <= {20, 21}  # where it turns
    assert located[19].advance == pytest.approx(advance, abs=0.3)
    assert located[-1].advance == pytest.approx(-1, abs=0.3)


def test_a_wrong_speed_is_a_warning_and_a_right_one_is_none():
    there = np.ones(200, bool)
    drives = {advance: Route(Drive(advance)) for advance in (1.0, 4.0)}

    def follow(advance):
        for turn in range(40):
            drives[advance](sharp(20 + 4 * turn, 0.6), there)

    follow(4.0)
    with pytest.warns(UserWarning, match=r"the images fit (3\.9|4\.0) rows from one to the next far better than 1;"):
        follow(1.0)


@pytest.mark.parametrize("advance", [3, -2, 0])
def test_a_sure_robot_moves_as_its_drive_says(advance):
    there, drive_route = np.ones(60, bool), Route(Drive(advance, 0.05, 0.0))
    for turn in range(6):
        located = drive_route(sharp(30) if turn == 0 else None, there)
        assert located.row == 30 + turn * advance
        assert located.p > 0.98 * (1 - located.off)
        assert located.advance == pytest.approx(advance, abs=1e-5)


def test_it_finds_a_robot_that_was_carried_away():
    there, drive_route = np.ones(200, bool), Route(Drive())
    for turn in range(20):
        assert drive_route(sharp(turn, 0.5), there).row == turn
    assert drive_route(sharp(150, 0.5), there).row == 20  # one image may err
    for turn in range(1, 4):
        located = drive_route(sharp(150 + turn, 0.5), there)
    assert located.row == 153
    assert located.p > 0.9
    stuck = Route(Drive(kidnapped=0.0))
    for turn in range(20):
        stuck(sharp(turn, 0.5), there)
    assert stuck(sharp(150, 0.5), there).row < 30


def refusal(reason="too few matches"):
    return Prediction(reason=reason)


def test_ten_refused_images_are_off_the_map_and_five_are_not():
    there, tunnel, elsewhere, untouched = np.ones(200, bool), Route(), Route(), Route()
    for row in range(20):
        for drive_route in (tunnel, elsewhere, untouched):
            drive_route(sharp(row, 0.6), there)
    for row in range(20, 25):
        in_tunnel, outside = tunnel(refusal(), there), untouched(sharp(row, 0.6), there)
        assert in_tunnel.row == outside.row == row
    assert 0.5 < in_tunnel.off < 0.7
    after, outside = tunnel(sharp(25, 0.6), there), untouched(sharp(25, 0.6), there)
    assert (after.row, outside.row) == (25, 25)
    assert after.p > 0.9 * outside.p
    assert tunnel(sharp(26, 0.6), there).p > 0.99
    for _ in range(10):
        located = elsewhere(refusal(), there)
    assert located.off >= 0.9
    assert located.p < 0.1
    assert located.row is None
    back = [elsewhere(sharp(row, 0.6), there) for row in range(150, 155)]  # somewhere else on the map
    assert back[-1].row == 154
    assert back[-1].p > 0.9


@pytest.mark.parametrize(
    ("refusals", "off"),
    [((0.5, 0.5), 0.5), ((0.4, 0.6), 0.6), ((0.01, 0.9), 2.5 / 3.5), ((0.9, 0.5), 0.5), ((0.0, 0.0), 2.5 / 3.5)],
)
def test_refused_images_are_evidence_as_far_as_the_calibration_says(refusals, off):
    there, drive_route = np.ones(30, bool), Route(Drive(leaves=1e-9, returns=1e-9))  # off with a probability of 0.5
    for prediction in (None, refusal("no candidates")):
        assert drive_route(prediction, there).off == pytest.approx(0.5, abs=1e-6)
    located = drive_route(refusal(), there, refusals)
    assert located.off == pytest.approx(off, abs=1e-6)


def test_a_sum_of_one_and_never_nan():
    there, drive_route = np.ones(30, bool), Route(Drive(1, 0.1, 0.0))
    infinite = prediction({4: math.nan}, 1.0), prediction({4: math.inf, 5: 1.0}, 1.0)
    for says in (sharp(3), sharp(20), None, *infinite, sharp(0), *[None] * 200):  # at last beyond the end of the map
        located = drive_route(says, there)
        assert drive_route.belief.sum() == pytest.approx(1, abs=1e-5)
        assert 0 <= located.p <= 1


def test_the_map_may_grow_and_costs_few_programs(compilations):
    drive_route = Route(Drive())
    assert drive_route(sharp(0), np.zeros(0, bool)) is None
    assert drive_route(sharp(0), np.zeros(4, bool)) is None
    for _ in range(2):  # the first image, and the others
        assert drive_route(sharp(2), np.ones(3, bool)).row == 2
    compilations.reset()
    for rows in range(4, 1000, 50):
        assert drive_route(sharp(rows - 1), np.ones(rows, bool)).row < rows
    assert compilations.count == 0
    assert drive_route(sharp(1500), np.ones(1600, bool)).row == 1500
    assert len(drive_route.belief) == 2 * route.FIRST_ROWS
