"""OpenCV's homography: what a call of one's own says, wherever scores are asked for."""

from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest

from mfvpr import OpenCvHomography, score_candidates, score_grid
from mfvpr.evaluation import stages
from mfvpr.matching import MatchSet
from mfvpr.tuning import sweeps
from mfvpr.types import Shortlist, per_match
from mfvpr.utils import InputError
from tests.builders import make_matches
from tests.scoring.test_homography import plane_points, stacked

pytestmark = pytest.mark.optimized

POINTS = [plane_points(seed, count, share) for seed, (count, share) in enumerate([(60, 0.5), (120, 0.2), (20, 0.8)])]
BATCH = stacked([make_matches(points0, points1, capacity=128, index0=np.arange(len(points0)))
                 for points1, points0 in POINTS])  # fmt: skip


def expected(estimator, threshold=8.0, iterations=2000):
    return [cv2.findHomography(*points, estimator, threshold, maxIters=iterations, confidence=0.995)[1].sum()
            for points in POINTS]  # fmt: skip


@pytest.mark.parametrize(("name", "estimator"), [("ransac", cv2.RANSAC), ("magsac", cv2.USAC_MAGSAC)])
def test_it_says_what_opencv_says(name, estimator):
    scorer = OpenCvHomography(8.0, estimator=name)
    scores = score_candidates(scorer, BATCH)
    assert (scores.dtype, scores.tolist()) == (np.float32, expected(estimator))
    one = jax.tree.map(lambda leaf: leaf[1], BATCH)
    assert float(scorer(one)) == scores[1]
    shuffle = np.random.default_rng(0).permutation(128)
    entries = {entry: values[shuffle] for entry, values in per_match(one).items()}
    assert float(scorer(replace(one, mask=one.mask[shuffle], **entries))) == scores[1]


def test_without_numbers_of_keypoints_no_order_matters():
    points1, points0 = POINTS[1]
    shuffle = np.random.default_rng(1).permutation(len(points1))
    scores = {float(OpenCvHomography()(make_matches(points0[order], points1[order])))
              for order in (slice(None), shuffle)}  # fmt: skip
    assert len(scores) == 1


def test_grids_data_sets_and_sweeps_score_alike():
    grid = score_grid(OpenCvHomography(estimator="magsac"), BATCH, threshold=[4.0, 8.0], max_iterations=[50, 2000])
    for row, threshold in enumerate([4.0, 8.0]):
        for column, iterations in enumerate([50, 2000]):
            assert grid[row, column].tolist() == expected(cv2.USAC_MAGSAC, threshold, iterations)
    lines = {name: np.concatenate([values[pair][BATCH.mask[pair]] for pair in range(3)])
             for name, values in per_match(BATCH).items()}  # fmt: skip
    row = replace(BATCH, mask=np.ones(200, bool), image_size0=BATCH.image_size0[0], **lines)
    match_set = MatchSet.of([row], np.array([[60, 120, 20]]))
    candidates = Shortlist(np.arange(3)[None], np.array([[0.3, 0.2, 0.1]], np.float32), np.ones((1, 3), bool))
    scorers = {"opencv": OpenCvHomography(8.0), "magsac": OpenCvHomography(8.0, estimator="magsac")}
    scores = stages.score(scorers, match_set, candidates)
    assert scores["opencv"].tolist() == [expected(cv2.RANSAC)]
    assert scores["magsac"].tolist() == [expected(cv2.USAC_MAGSAC)]
    settings = [{"threshold": 8.0, "max_distance": distance} for distance in (0.4, 0.6)]  # all are 0.5 apart
    rows = sweeps.sweep(scorers["opencv"], settings, match_set, candidates)
    assert rows[0, 0, 0].tolist()[:3] == [0, 1, 2]  # nothing matches: the filter's order
    assert rows[0, 1, 0].tolist()[:3] == np.argsort(expected(cv2.RANSAC))[::-1].tolist()


@pytest.mark.parametrize("trace", [jax.jit, jax.vmap, jax.grad])
def test_jax_cannot_look_into_it(trace):
    matches = BATCH if trace is jax.vmap else jax.tree.map(lambda leaf: leaf[0], BATCH)
    points = matches.points0
    with pytest.raises(InputError, match=r"homography_opencv: .*jit .*vmap .*grad"):
        trace(lambda points, matches: OpenCvHomography()(replace(matches, points0=points)))(points, matches)


@pytest.mark.parametrize(
    "wrong", [{"threshold": 0.0}, {"threshold": np.nan}, {"confidence": 1.0}, {"max_iterations": 0.0}]
)
def test_numbers_that_opencv_would_replace_are_refused(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))}=.*: expected numbers"):
        score_candidates(OpenCvHomography(**wrong), BATCH)


def test_a_confidence_that_is_no_number_is_no_score():
    points1, points0 = POINTS[0]
    assert np.isnan(OpenCvHomography()(make_matches(points0, points1, confidence=np.full(60, np.nan))))


def test_few_matches_and_broken_ones():
    points1, points0 = plane_points(3, 4, 1.0)
    for count in range(4):
        matches = make_matches(points0[:count], points1[:count], capacity=8)
        assert float(OpenCvHomography()(matches)) == count
        assert float(OpenCvHomography(few="zero")(matches)) == 0
    assert float(OpenCvHomography(few="zero")(make_matches(points0, points1))) == 4
    assert float(OpenCvHomography()(make_matches(np.full((20, 2), 3.0), np.full((20, 2), 5.0)))) == 0
    assert np.isnan(OpenCvHomography()(make_matches(points0 * np.nan, points1)))
    unsure = replace(make_matches(points0, points1), confidence=np.array([1, 1, 0.5, 0], np.float32))
    assert float(OpenCvHomography()(unsure)) == 3
