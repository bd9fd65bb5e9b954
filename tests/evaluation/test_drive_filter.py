"""Rankings along a drive, against all paths of a small map in float64, and what is known of easy drives."""

import math

import numpy as np
import pytest

from mfvpr.evaluation import drives
from mfvpr.evaluation.drives import LAG, Drive, DriveFilter, Evidence, follow
from mfvpr.evaluation.rankings import Ranked
from mfvpr.utils import InputError

SPEEDS = (-1, 1, 2)


def next_speeds(speed, speeds):
    """Probabilities of the speeds after `speed`: it stays, changes by a few rows, or becomes any other."""
    few = {other: math.exp(-((other - speed) ** 2) / 2) for other in speeds if other != speed}
    total = sum(few.values())
    return {
        other: 0.98 * (0.95 if other == speed else 0.05 * few[other] / total) + 0.02 / len(speeds) for other in speeds
    }


def moves(speed, drive):
    """Probabilities of the changes of the row at a speed."""
    weights = {k: math.exp(-((k - speed) ** 2) / (2 * drive.spread**2))
               for k in range(-50, 51) if abs(k - speed) <= 4 * drive.spread}  # fmt: skip
    return {k: weight / sum(weights.values()) for k, weight in weights.items()}


def motions(drive, speeds, there):
    """Ways from each state to each other one, as lists of probabilities."""
    size = len(there)
    states = [(row, speed) for row in range(size) for speed in speeds]
    anywhere = {(row, speed): there[row] / (sum(there) * len(speeds)) for row, speed in states}
    ways = {(a, b): [drive.kidnapped * anywhere[b]] for a in states for b in states}
    for row, speed in states:
        for other, chance in (next_speeds(speed, speeds) if len(speeds) > 1 else {speed: 1.0}).items():
            for k, p in moves(other, drive).items():
                p *= (1 - drive.kidnapped) * chance
                if 0 <= row + k < size:
                    ways[(row, speed), (row + k, other)].append(p)
                else:
                    for end in states:
                        ways[(row, speed), end].append(p * anywhere[end])
    return ways


def likelihoods(ranked, odds, there, correct):
    """Likelihood of an image at each row, from the module's first lines."""
    scores = {int(row): float(score) for row, score in zip(*ranked, strict=True) if row >= 0}
    mean = sum(scores.values()) / len(scores)
    above = {row: max(0.0, score - mean) ** 2 for row, score in scores.items()}
    beside = [0.0] * len(there)
    for row, share in above.items():
        for k in range(-4, 5):
            if 0 <= row + k < len(there) and there[row + k]:
                beside[row + k] += share * math.exp(-(k**2) / 2)
    return [correct * odds * share / sum(beside) * sum(there) + 1 - correct if is_there else 1.0
            for share, is_there in zip(beside, there, strict=True)]  # fmt: skip


def beliefs_by_loops(ways, seen, start):
    """Probabilities of the states at each image from it and earlier ones, and what the later images say of them."""
    states, forward, belief = [*start], [], start
    for here in seen:
        moved = {b: sum(belief[a] * p for a in states for p in ways[a, b]) for b in states}
        forward.append(belief := {state: moved[state] * here[state[0]] for state in states})
    backward = [dict.fromkeys(states, 1.0)]
    for here in seen[:0:-1]:
        later = {state: backward[0][state] * here[state[0]] for state in states}
        backward.insert(0, {a: sum(p * later[b] for b in states for p in ways[a, b]) for a in states})
    return forward, backward


def off_by_loops(drive, forward):
    """Probability at each image that the robot is not on the map."""
    off, totals = drive.leaves / (drive.leaves + drive.returns), [sum(belief.values()) for belief in forward]
    result = []
    for turn, total in enumerate(totals):
        chance = total / (totals[turn - 1] if turn else 1)
        moved = (1 - drive.returns) * off + drive.leaves * (1 - off) if turn else off
        off = moved / (moved + (1 - moved) * chance)
        result.append(off)
    return result


@pytest.mark.parametrize("advance", [None, 0.7])
@pytest.mark.parametrize("method", ["causal", "smoothed"])
def test_rows_are_those_of_all_paths(method, advance, monkeypatch):
    monkeypatch.setattr(drives, "SPEEDS", SPEEDS)
    rng, there = np.random.default_rng(0), [True, True, False, True, True, True, True]
    speeds, present = SPEEDS if advance is None else (advance,), np.flatnonzero(there)
    drive = Drive(advance, 0.6, 0.05, 0.1, 0.3, 0.6)
    ranked = Ranked(np.stack([rng.permutation(present)[:4] for _ in range(7)]), rng.exponential(size=(7, 4)))
    confidence = rng.uniform(0.1, 0.95, 7)
    seen = [likelihoods((ranked.rows[image], ranked.scores[image]), p / (1 - p), there, 0.6)
            for image, p in enumerate(confidence)]  # fmt: skip
    start = {(row, speed): is_there / (len(present) * len(speeds)) for row, is_there in enumerate(there)
             for speed in speeds}  # fmt: skip
    ways = motions(drive, speeds, there)
    forward, backward = beliefs_by_loops(ways, seen, start)
    followed = follow(Evidence.of(ranked, confidence), drive, np.array(there), method)
    np.testing.assert_allclose(followed.off, off_by_loops(drive, forward), rtol=1e-4)
    for image in range(7):
        later = backward[image] if method != "causal" else dict.fromkeys(start, 1.0)
        both = {state: forward[image][state] * later[state] for state in start}
        by_row = np.array([sum(both[row, speed] for speed in speeds) for row in range(7)]) / sum(both.values())
        np.testing.assert_allclose(followed.p[image], by_row[followed.rows[image]], rtol=1e-4)
        assert followed.rows[image].tolist() == sorted(present, key=lambda row: -by_row[row])[:4]


def random_rankings(number, size, seed=0):
    rng = np.random.default_rng(seed)
    rows = np.stack([rng.choice(size, 6, replace=False) for _ in range(number)])
    return Ranked(rows, -np.sort(-rng.exponential(size=rows.shape)))


def test_a_lagged_row_is_the_smoothed_one_of_a_drive_that_ends_there():
    ranked, evidence = random_rankings(12, 30), Evidence.of(random_rankings(12, 30))
    lagged = follow(evidence, Drive(), np.ones(30, bool), "lagged")
    for image in (3, 11):
        seen = Ranked(ranked.rows[: image + LAG + 1], ranked.scores[: image + LAG + 1])
        smoothed = follow(Evidence.of(seen), Drive(), np.ones(30, bool), "smoothed")
        assert lagged.rows[image].tolist() == smoothed.rows[image].tolist()
        np.testing.assert_allclose(lagged.p[image], smoothed.p[image], rtol=1e-3)


def drive_of(places, size, stands_out):
    """Rankings of images with 20 candidates; the first one is the place, and its score may stand out."""
    rng = np.random.default_rng(1)
    rows = np.stack([[place, *rng.choice(np.delete(np.arange(size), place), 19, replace=False)] for place in places])
    scores = rng.uniform(0.8, 1.2, rows.shape)
    scores[:, 0] = np.where(stands_out, 5.0, 1.2)
    return Ranked(rows, scores)


@pytest.mark.parametrize("method", ["causal", "lagged", "smoothed"])
@pytest.mark.parametrize("speed", [1, 4, -3])
def test_a_drive_corrects_images_that_see_another_place(method, speed):
    places = np.arange(40) * speed if speed > 0 else 199 + np.arange(40) * speed
    is_wrong = np.isin(np.arange(40), np.arange(10, 40, 7))
    ranked = drive_of(places, 200, ~is_wrong)
    ranked.rows[is_wrong, :2] = ranked.rows[is_wrong, :2][:, ::-1].copy()  # another place has the highest score
    sequence = DriveFilter(method)(ranked, 200)
    assert (np.abs(sequence.rows[2:, 0] - places[2:]) <= 1).all()
    assert (np.diff(sequence.scores, axis=1) <= 0).all()


def test_images_of_no_place_are_off_the_map():
    """Scores that do not stand out, image after image: the robot has left the map, and comes back."""
    there = (np.arange(30) < 10) | (np.arange(30) >= 20)
    ranked = drive_of(np.arange(30), 100, there)
    followed = follow(Evidence.of(ranked), Drive(), np.ones(100, bool))
    off, scores = followed.off, DriveFilter()(ranked, 100).scores
    np.testing.assert_allclose(scores, followed.p * (1 - off[:, None]), rtol=1e-6)
    assert scores[15:20].max() < 0.2 < scores[there, 0][1:].min()
    assert (off[there][1:] < 0.1).all()
    assert (off[15:20] > 0.8).all()


def test_images_without_candidates_say_nothing():
    ranked = random_rankings(6, 30)
    rows, scores = ranked.rows.copy(), ranked.scores.copy()
    rows[3], scores[3] = -1, np.nan
    rows[4, 2:], scores[4, 2:] = -1, np.nan
    result = DriveFilter()(Ranked(rows, scores), 30)
    assert np.isfinite(result.scores).all()
    assert DriveFilter("smoothed")(Ranked(rows[:0], scores[:0]), 30).rows.shape == (0, 6)
    assert DriveFilter("smoothed")(Ranked(rows[:1], scores[:1]), 3).rows.shape == (1, 3)


@pytest.mark.parametrize("method", ["causal", "smoothed"])
def test_excluded_rows_are_not_ranked(method):
    ranked, excluded = drive_of(np.arange(30), 40, True), np.abs(np.arange(30)[:, None] - np.arange(40)) <= 2
    every, sequence = DriveFilter(method)(ranked, 40), DriveFilter(method)(ranked, 40, excluded)
    assert sequence.rows.shape == (30, 20)
    for query in range(30):
        left = every.rows[query][np.abs(every.rows[query] - query) > 2]
        assert sequence.rows[query, : len(left)].tolist() == left.tolist()
        assert (np.abs(sequence.rows[query] - query) > 2).all()
    empty = DriveFilter(method)(ranked, 40, np.ones((30, 40), bool))
    assert (empty.rows == -1).all()
    assert np.isnan(empty.scores).all()


def test_wrong_arguments_are_one_line():
    with pytest.raises(InputError, match="method"):
        DriveFilter("best")
    with pytest.raises(InputError, match=r"drive: expected Drive\(...\), got 0.5"):
        DriveFilter("causal", 0.5)
    with pytest.raises(InputError, match=r"advance='slow'.*expected numbers"):
        Drive(advance="slow")
