"""Frame correlation against the public code's loop, place by place."""

import numpy as np
import pytest

from mfvpr.core.types import Shortlist
from mfvpr.evaluation import FrameCorrelation
from mfvpr.utils import InputError


def by_loops(rows, scores, previous):
    """As published: the recognized places so far, and what each candidate gains by them."""
    places, weighted = [], []
    for query, (own_rows, own_scores) in enumerate(zip(rows, scores, strict=True)):
        new = []
        for row, score in zip(own_rows, own_scores, strict=True):
            gain = 0.0
            if query >= previous:
                last = places[-previous:]
                best = max(score for _, score in last)
                for place, of_place in last:
                    strength = 1 if previous == 1 or best == 0 else of_place / best
                    if place is not None and abs(row - place) <= 15:
                        gain = max(gain, strength * (0.4 / 15 * (15 - abs(row - place))))
            new.append(score * (1 + gain) if row >= 0 and score > 0 else score)
        usable = [(-score, row) for row, score in zip(own_rows, new, strict=True) if row >= 0 and score > 0]
        score, row = min(usable, default=(0, None))
        places.append((row, -score))
        weighted.append(new)
    return weighted


def drive(seed, queries=40, candidates=6, database=50):
    rng = np.random.default_rng(seed)
    rows = np.array([rng.permutation(database)[:candidates] for _ in range(queries)], np.int32)
    scores = rng.integers(0, 5, rows.shape).astype(np.float32) * 10  # with ties
    rows[rng.random(rows.shape) < 0.1] = -1
    scores[5:8] = 0
    scores[11] = -scores[11]
    return Shortlist(rows, np.zeros(rows.shape, np.float32), rows >= 0), scores


@pytest.mark.parametrize("previous", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_loop(seed, previous):
    candidates, scores = drive(seed)
    got = FrameCorrelation(previous)(candidates, scores)
    np.testing.assert_allclose(got, by_loops(candidates.indices, scores, previous), rtol=1e-6)
    assert (got[candidates.mask & (scores > 0)] > scores[candidates.mask & (scores > 0)]).any()
    np.testing.assert_array_equal(got[:previous], scores[:previous])


def test_nan_stays_nan_and_is_no_place():
    rows, scores = np.array([[3, 9], [3, 9]], np.int32), np.array([[np.nan, 2], [1, 1]], np.float32)
    got = FrameCorrelation(1)(Shortlist(rows, scores, rows >= 0), scores)
    np.testing.assert_allclose(got, [[np.nan, 2], [1 + 0.4 * 9 / 15, 1.4]], rtol=1e-6)


def test_numbers_without_meaning_raise():
    for incorrect in ((0,), (1, 0.0), (1, 1.0, -0.1), (1, np.inf)):
        with pytest.raises(InputError, match="expected at least one query"):
            FrameCorrelation(*incorrect)
