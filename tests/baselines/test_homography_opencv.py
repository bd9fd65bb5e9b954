"""Scorers on the host: OpenCV's homography beside plain calls of OpenCV, and scorers of users that break the rules."""

from dataclasses import field, replace
from typing import Any

import cv2
import jax
import numpy as np
import pytest

import mfvpr
from mfvpr import OpenCvHomography, score_candidates, score_grid
from mfvpr.core.types import Shortlist
from mfvpr.core.types import per_match as per_match_of
from mfvpr.evaluation import stages
from mfvpr.matchers import MatchSet
from mfvpr.tuning import sweeps
from mfvpr.utils import InputError
from tests.baselines.test_homography import plane_points
from tests.builders import make_matches, per_match, stack
from tests.scorers import pair_of
from tests.shapes import unchecked_shapes

pytestmark = pytest.mark.optimized

COUNTS = (60, 120, 20)
POINTS = [plane_points(seed, *case) for seed, case in enumerate(zip(COUNTS, (0.5, 0.2, 0.8), strict=True))]
PAIRS = [make_matches(points0, points1, capacity=128, index0=np.arange(len(points0))) for points1, points0 in POINTS]
BATCH = stack(PAIRS)
LINES = {name: values[BATCH.mask] for name, values in per_match_of(BATCH).items()}
ROW = replace(BATCH, mask=np.ones(200, bool), image_size0=BATCH.image_size0[0], **LINES)
MATCHES = MatchSet.of([ROW], np.array([COUNTS]))
CANDIDATES = Shortlist(np.arange(3)[None], np.array([[0.3, 0.2, 0.1]], np.float32), np.ones((1, 3), bool))


def count_inliers(estimator, threshold=8.0, iterations=2000):
    return [
        cv2.findHomography(*points, estimator, threshold, maxIters=iterations, confidence=0.995)[1].sum()
        for points in POINTS
    ]


@pytest.mark.parametrize(("name", "estimator"), [("ransac", cv2.RANSAC), ("magsac", cv2.USAC_MAGSAC)])
def test_it_says_what_opencv_says(name, estimator):
    scorer = OpenCvHomography(8.0, estimator=name)
    scores = score_candidates(scorer, BATCH)
    assert (scores.dtype, scores.tolist()) == (np.float32, count_inliers(estimator))
    shuffle = np.random.default_rng(0).permutation(128)
    for matches in (pair_of(BATCH, 1), per_match(pair_of(BATCH, 1), lambda rows: rows[shuffle])):
        assert float(scorer(matches)) == scores[1]


def test_grids_data_sets_and_sweeps_score_alike():
    grid = score_grid(OpenCvHomography(estimator="magsac"), BATCH, threshold=[4.0, 8.0], max_iterations=[50, 2000])
    expected = [[count_inliers(cv2.USAC_MAGSAC, threshold, most) for most in (50, 2000)] for threshold in (4.0, 8.0)]
    assert grid.tolist() == expected
    scorers = {"opencv": OpenCvHomography(8.0), "magsac": OpenCvHomography(8.0, estimator="magsac")}
    scores = stages.score(scorers, MATCHES, CANDIDATES)
    assert scores["opencv"].tolist() == [count_inliers(cv2.RANSAC)]
    assert scores["magsac"].tolist() == [count_inliers(cv2.USAC_MAGSAC)]
    settings = [{"threshold": 8.0, "max_distance": distance} for distance in (0.4, 0.6)]  # all are 0.5 apart
    rows = sweeps.rank_settings(scorers["opencv"], settings, MATCHES, CANDIDATES)
    assert rows[0, 0, 0].tolist()[:3] == [0, 1, 2]  # no match: the order of the retrieval
    assert rows[0, 1, 0].tolist()[:3] == np.argsort(count_inliers(cv2.RANSAC))[::-1].tolist()


@pytest.mark.parametrize("trace", [jax.jit, jax.vmap, jax.grad])
def test_jax_cannot_look_into_it(trace):
    matches = BATCH if trace is jax.vmap else pair_of(BATCH)
    with pytest.raises(InputError, match=r"homography_opencv: .*jit .*vmap .*grad"):
        trace(lambda points, matches: OpenCvHomography()(replace(matches, points0=points)))(matches.points0, matches)


@pytest.mark.parametrize(("field", "number"), [("threshold", 0.0), ("confidence", 1.0), ("max_iterations", 0.0)])
def test_numbers_that_opencv_would_replace_raise(field, number):
    with pytest.raises(InputError, match=f"{field}=.*: expected a number"):
        score_candidates(OpenCvHomography(**{field: number}), BATCH)


def test_few_matches_and_broken_ones():
    points1, points0 = plane_points(3, 4, 1.0)
    for count in range(4):
        matches = make_matches(points0[:count], points1[:count], capacity=8)
        assert float(OpenCvHomography()(matches)) == count
        assert float(OpenCvHomography(few="zero")(matches)) == 0
    assert float(OpenCvHomography(few="zero")(make_matches(points0, points1))) == 4
    assert float(OpenCvHomography()(make_matches(np.full((20, 2), 3.0), np.full((20, 2), 5.0)))) == 0
    assert np.isnan(OpenCvHomography()(make_matches(points0 * np.nan, points1)))
    with unchecked_shapes():
        matches = make_matches(points0, points1)
        assert float(OpenCvHomography()(replace(matches, mask=2 * matches.mask.astype(np.uint8)))) == 4
    assert float(OpenCvHomography()(make_matches(points0, points1, confidence=[1, 1, 0.5, 0]))) == 3
    assert np.isnan(OpenCvHomography()(make_matches(points0, points1, confidence=np.full(4, np.nan))))


@mfvpr.value
class Host:
    """Scores pairs by a function of their masks."""

    answer: Any = field(metadata={"static": True})

    def __call__(self, matches):
        return np.float32(0)

    def score_pairs(self, matches):
        return self.answer(np.asarray(matches.mask))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda _: 1.0, r"\d+ pairs, got an array"),
        (lambda masks: masks[:, :1], r"\d+ pairs, got an array"),
        (lambda masks: masks.sum(axis=1) * 1j, "real numbers.* got complex"),
    ],
)
def test_a_real_number_for_each_pair_is_expected(wrong, words):
    for score in (
        lambda scorer: score_candidates(scorer, BATCH),
        lambda scorer: score_grid(scorer, BATCH, max_distance=[9.0]),
        lambda scorer: sweeps.rank_settings(scorer, [{"max_distance": 9.0}], MATCHES, CANDIDATES),
    ):
        with pytest.raises(InputError, match=rf"Host\.score_pairs: .*{words}"):
            score(Host(wrong))


def test_a_class_that_is_no_value_raises():
    class Plain(OpenCvHomography):
        pass

    with pytest.raises(InputError, match=r"Plain: .*score_pairs.*decorate"):
        score_candidates(Plain(), BATCH)
