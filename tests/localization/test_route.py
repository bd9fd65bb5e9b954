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


def stepped_by_loops(belief, there, advance, spread, kidnapped, scores, p, sharpness):
    """`step` of a prediction, written from the module's first lines."""
    size = len(belief)
    rows = [row for row in range(size) if there[row]]
    before, moves = [0.0] * size, {}
    for k in range(-50, 51):
        if abs(k - advance) <= 4 * spread:
            moves[k] = math.exp(-((k - advance) ** 2) / (2 * spread**2))
    for row in range(size):
        for k, weight in moves.items():
            if 0 <= row + k < size and there[row + k]:
                before[row + k] += belief[row] * weight / sum(moves.values())
    total, anywhere = sum(before), [is_there / len(rows) for is_there in there]
    moved = [value / total for value in before] if total else anywhere
    before = [(1 - kidnapped) * stay + kidnapped * jump for stay, jump in zip(moved, anywhere, strict=True)]
    mean = sum(scores.values()) / len(scores)
    above = {row: max(0.0, score - mean) ** sharpness for row, score in scores.items()}
    after = []
    for row in range(size):
        share = above.get(row, 0.0) / sum(above.values())
        after.append(before[row] * (p * share + (1 - p) * anywhere[row]))
    return [value / sum(after) for value in after]


def test_it_is_the_filter_that_its_first_lines_state():
    rng, drive = np.random.default_rng(0), Drive(1.3, 0.8, 0.05, 0.4, 3.0)
    there, drive_route = np.ones(40, bool), Route(drive)
    there[[5, 17]] = False
    belief = [0.0] * 40
    for turn in range(30):
        rows = rng.choice(np.flatnonzero(there), 8, replace=False).tolist()
        scores = dict(zip(rows, rng.exponential(size=8).tolist(), strict=True))
        p = None if turn % 3 else float(rng.uniform())
        belief = stepped_by_loops(belief, there, 1.3, 0.8, 0.05, scores, 0.4 if p is None else p, 3.0)
        row, near = drive_route(prediction(scores, p), there)
        assert row == np.argmax(belief)
        assert near == pytest.approx(sum(belief[max(0, row - 2) : row + 3]), rel=1e-4)
        np.testing.assert_allclose(drive_route.belief[:40], belief, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("advance", [3, -2, 0])
def test_a_sure_robot_moves_as_its_drive_says(advance):
    there, drive_route = np.ones(60, bool), Route(Drive(advance, 0.05, 0.0))
    assert drive_route(sharp(30), there) == (30, 1)
    for turn in range(1, 6):
        assert drive_route(None, there) == (30 + turn * advance, 1)


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
    assert drive_route(sharp(20), there) == (4, 1)  # image and motion exclude each other: the motion decides
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
