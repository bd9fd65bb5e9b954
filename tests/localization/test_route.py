"""The filter over the rows of a map, against explicit loops in float64 and what is known in closed form."""

import math

import numpy as np
import pytest

from mfvpr.localization import Alternative, Drive, Prediction, Route, route
from mfvpr.localization.route import motion, shares
from mfvpr.utils import InputError


def prediction(scores, p=None):
    """A prediction with scores by row."""
    alternatives = tuple(Alternative(row, str(row), row, score) for row, score in scores.items())
    return Prediction(None, alternatives, 0.0, p, None, None, None)


def sharp(row, p=1.0):
    """A prediction that is sure of one row."""
    return prediction({row: 3.0}, p)


def next_speeds(speed, speeds):
    """Probabilities of the speeds after `speed`: it stays, changes by a few rows, or becomes any other."""
    few = {other: math.exp(-((other - speed) ** 2) / 2) for other in speeds if other != speed}
    total = sum(few.values())
    return {
        other: 0.98 * (0.95 if other == speed else 0.05 * few[other] / total) + 0.02 / len(speeds) for other in speeds
    }


def stepped_by_loops(belief, there, drive, scores, p):
    """`step` of a prediction, written from the module's first lines; beliefs by (row, speed)."""
    size, speeds = len(there), sorted({speed for _, speed in belief})
    rows = [row for row in range(size) if there[row]]
    before = dict.fromkeys(belief, 0.0)
    for (row, speed), value in belief.items():
        for other, chance in (next_speeds(speed, speeds) if len(speeds) > 1 else {speed: 1.0}).items():
            moves = {k: math.exp(-((k - other) ** 2) / (2 * drive.spread**2))
                     for k in range(-50, 51) if abs(k - other) <= 4 * drive.spread}  # fmt: skip
            for k, weight in moves.items():
                if 0 <= row + k < size and there[row + k]:
                    before[row + k, other] += value * chance * weight / sum(moves.values())
    total, states = sum(before.values()), len(rows) * len(speeds)
    anywhere = {(row, speed): there[row] / states for row, speed in before}
    before = {state: (1 - drive.kidnapped) * (value / total if total else anywhere[state])
              + drive.kidnapped * anywhere[state] for state, value in before.items()}  # fmt: skip
    mean = sum(scores.values()) / len(scores)
    above = {row: max(0.0, score - mean) ** drive.sharpness for row, score in scores.items()}
    beside = [0.0] * size
    for row, share in above.items():
        for k in range(-4, 5):
            if 0 <= row + k < size and there[row + k]:
                beside[row + k] += share * math.exp(-(k**2) / 2)
    after = {(row, speed): value * (p * beside[row] / sum(beside) + (1 - p) * there[row] / len(rows))
             for (row, speed), value in before.items()}  # fmt: skip
    return {state: value / sum(after.values()) for state, value in after.items()}


@pytest.mark.parametrize("advance", [1.3, None])
def test_it_is_the_filter_that_its_first_lines_state(advance, monkeypatch):
    monkeypatch.setattr(route, "SPEEDS", (-2, 0, 1, 3))
    rng, drive = np.random.default_rng(0), Drive(advance, 0.8, 0.05, 0.4, 3.0)
    there, drive_route = np.ones(40, bool), Route(drive)
    there[[5, 17]] = False
    speeds = route.SPEEDS if advance is None else (advance,)
    belief = {(row, speed): 0.0 for row in range(40) for speed in speeds}
    for turn in range(12):
        rows = rng.choice(np.flatnonzero(there), 8, replace=False).tolist()
        scores = dict(zip(rows, rng.exponential(size=8).tolist(), strict=True))
        p = None if turn % 3 else float(rng.uniform())
        belief = stepped_by_loops(belief, there, drive, scores, 0.4 if p is None else p)
        by_row = [sum(belief[row, speed] for speed in speeds) for row in range(40)]
        located = drive_route(prediction(scores, p), there)
        assert located.row == np.argmax(by_row)
        assert located.p == pytest.approx(sum(by_row[max(0, located.row - 2) : located.row + 3]), rel=1e-4)
        assert located.advance == pytest.approx(sum(speed * value for (_, speed), value in belief.items()), abs=1e-4)
        np.testing.assert_allclose(drive_route.belief[:40], by_row, rtol=1e-3, atol=1e-7)


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
        assert located.p > 0.98
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


def test_a_sum_of_one_and_never_nan():
    there, drive_route = np.ones(30, bool), Route(Drive(1, 0.1, 0.0))
    infinite = prediction({4: math.nan}, 1.0), prediction({4: math.inf, 5: 1.0}, 1.0)
    drive_route(sharp(3), there)
    assert drive_route(sharp(20), there)[:2] == (
        4,
        pytest.approx(1, abs=0.01),
    )  # image and motion exclude each other: the motion decides
    for says in (None, *infinite, sharp(0), *[None] * 200):  # at last beyond the end of the map, with nothing left
        located = drive_route(says, there)
        assert drive_route.belief.sum() == pytest.approx(1, abs=1e-5)
        assert 0 <= located.p <= 1


def test_the_map_may_grow_and_costs_few_programs(compilations):
    drive_route = Route(Drive())
    assert drive_route(sharp(0), np.zeros(0, bool)) is None
    assert drive_route(sharp(0), np.zeros(4, bool)) is None
    assert drive_route(sharp(2), np.ones(3, bool)).row == 2
    compilations.reset()
    for rows in range(4, 1000, 50):
        assert drive_route(sharp(rows - 1), np.ones(rows, bool)).row < rows
    assert compilations.count == 0
    assert drive_route(sharp(1500), np.ones(1600, bool)).row == 1500
    assert len(drive_route.belief) == 2 * route.FIRST_ROWS


@pytest.mark.parametrize(("scores", "expected"), [
    ([4.0], [1]), ([2.0, 2.0], [0.5, 0.5]), ([3.0, 1.0, 2.0], [1, 0, 0]), ([4.0, 3.0, 0, 1], [0.8, 0.2, 0, 0]),
    ([np.nan, 2.0], [0, 1]), ([np.nan], [0]), ([-1.0, -3.0], [1, 0]), ([1e-30, 0.0], [1, 0]),
])  # fmt: skip
def test_shares(scores, expected):
    np.testing.assert_allclose(shares(np.array(scores), 2.0), expected, atol=1e-12)


def test_motions_are_probabilities():
    for advance, spread in ((0, 1), (1, 0.01), (0.5, 0.01), (-3.4, 2), (1000, 1)):
        weights = motion(advance, spread)
        assert len(weights) % 2 == 1
        assert weights.sum() == pytest.approx(1, abs=1e-5)
        steps = np.arange(len(weights)) - len(weights) // 2
        assert weights @ steps == pytest.approx(advance, abs=0.01 + (0.5 if spread < 0.1 else 0) * (advance % 1 > 0))


@pytest.mark.parametrize("incorrect", [
    {"advance": math.nan}, {"spread": 0}, {"sharpness": math.inf}, {"kidnapped": 1.1}, {"confidence": -0.1},
])  # fmt: skip
def test_drives_that_cannot_be(incorrect):
    with pytest.raises(InputError, match=r"Drive\("):
        Drive(**incorrect)
