"""RANSAC in one batch: against loops in double precision, OpenCV, and what no sampling may change."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from mfvpr import Homography, score_candidates
from mfvpr.baselines import homography
from mfvpr.utils import NoGradientError
from mfvpr.utils.numerics import masked
from tests import ransac_oracle
from tests.builders import SIZE, make_matches, stack

pytestmark = pytest.mark.thorough

CAPACITY = 320  # of all pairs of matches, because each shape compiles for seconds

PLANE = np.array([[1.05, 0.05, 8.0], [-0.03, 0.97, -5.0], [1e-4, -5e-5, 1.0]])  # candidate -> query
estimate = jax.jit(lambda scorer, matches: scorer.estimate(matches))


def score(matches, *numbers, **options):
    return float(estimate(Homography(*numbers, **options), matches).score)


def plane_points(seed, count, share, *, noise=2.0):
    """(points of the candidate, points of the query) `[n, 2]`, a share of which one plane explains up to noise."""
    rng = np.random.default_rng(seed)
    points1 = rng.uniform(0, SIZE, (count, 2))
    points0 = ransac_oracle.mapped(PLANE, points1) + rng.normal(0, noise, (count, 2))
    wrong = rng.permutation(count)[round(share * count) :]
    points0[wrong] = rng.uniform(0, SIZE, (len(wrong), 2))
    return points1.astype(np.float32), points0.astype(np.float32)


def pair(seed, count, share, *, capacity=CAPACITY, **options):
    points1, points0 = plane_points(seed, count, share, **options)
    return make_matches(points0, points1, capacity=capacity)


def misses(matrix, matches):
    """Pixels between the real matches' points of the query and those that the matrix maps there."""
    real = matches.mask
    return np.linalg.norm(ransac_oracle.mapped(matrix, matches.points1[real]) - matches.points0[real], axis=1)


@pytest.mark.slow
@pytest.mark.optimized
@pytest.mark.parametrize(("count", "share"), [(5, 0.9), (8, 0.6), (40, 0.3), (120, 0.1), (120, 0.5), (300, 0.9)])
@pytest.mark.parametrize("threshold", [8.0, 24.0])
def test_it_is_the_search_sample_by_sample_in_double_precision(count, share, threshold):
    for seed in range(3):
        matches = pair([seed, count], count, share)
        got = estimate(Homography(threshold, 500.0, seed=seed), matches)
        points = np.where(matches.mask[:, None], np.concatenate([matches.points1, matches.points0], axis=-1), 0)
        order = np.asarray(homography.canonical_order(points, matches.mask))[:count]
        inliers, samples, errors = ransac_oracle.estimate(
            points[order, :2], points[order, 2:], threshold=threshold, max_iterations=500, seed=seed
        )
        sure = np.abs(errors - threshold) > 1e-3 * threshold
        assert (np.asarray(got.inliers)[order][sure] == inliers[sure]).all()
        assert abs(int(got.score) - inliers.sum()) <= (~sure).sum()
        assert int(got.samples) == samples


def test_draws_are_distinct_and_every_set_is_as_likely():
    drawn = np.sort(np.asarray(homography.draw_four(jax.random.key(1), 0, np.int32(6))), axis=0)
    assert (np.diff(drawn, axis=0) > 0).all()
    assert (drawn.min(), drawn.max()) == (0, 5)
    _, counts = np.unique(drawn, axis=1, return_counts=True)
    expected = drawn.shape[1] / 15
    assert len(counts) == 15
    assert ((counts - expected) ** 2 / expected).sum() < 36  # chi-square of 14 degrees: p = 0.001


@pytest.mark.slow
def test_least_squares_are_those_of_scipy():
    matches = pair(4, 200, 0.6)
    plain, refit = (estimate(Homography(8.0, refit=again), matches) for again in (False, True))
    inliers = np.asarray(plain.inliers)
    points1, points0 = matches.points1[inliers].astype(float), matches.points0[inliers].astype(float)

    def differences(free):
        return (ransac_oracle.mapped(np.append(free, 1).reshape(3, 3), points1) - points0).ravel()

    start = np.asarray(plain.matrix, float).ravel()[:8]
    best = least_squares(differences, start, x_scale="jac", xtol=1e-15, ftol=1e-15)
    cost = np.sum(differences(np.asarray(refit.matrix, float).ravel()[:8] / float(refit.matrix[2, 2])) ** 2)
    assert cost <= 2 * best.cost * (1 + 1e-4)
    errors = misses(np.append(best.x, 1).reshape(3, 3), matches)
    assert abs(int(refit.score) - (errors <= 8).sum()) <= 1
    assert int(refit.score) > int(plain.score)


@pytest.mark.slow
@pytest.mark.optimized
def test_as_many_inliers_as_opencv():
    pairs = [plane_points(seed, 200, 0.4, noise=1.0) for seed in range(30)]
    expected = [
        cv2.findHomography(*points, cv2.RANSAC, 24.0, maxIters=2000, confidence=0.995)[1].sum() for points in pairs
    ]
    batch = stack([make_matches(points0, points1) for points1, points0 in pairs])
    difference = np.asarray(score_candidates(Homography(24.0, refit=True), batch)) - expected
    assert np.median(difference) == 0
    assert np.mean(np.abs(difference) <= 2) >= 0.95


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_few_matches(count):
    matches = pair(8, count, 1.0)
    assert score(matches) == count
    assert score(matches, few="zero") == (4 if count == 4 else 0)
    assert np.isnan(estimate(Homography(), matches).matrix).all() == (count < 4)


LINE = np.stack([np.linspace(0, 300, 20), np.linspace(10, 200, 20)], axis=1)


@pytest.mark.parametrize(
    ("points1", "points0"),
    [(LINE, LINE), (LINE, LINE[::-1]), (np.full((20, 2), 7.0), LINE), (np.full((20, 2), 7.0), np.full((20, 2), 9.0))],
)
def test_no_homography_explains_a_line_or_a_point(points1, points0):
    estimated = estimate(Homography(), make_matches(points0, points1, capacity=CAPACITY))
    assert (float(estimated.score), int(estimated.samples)) == (0, 0)
    assert np.isnan(estimated.matrix).all()
    assert not np.asarray(estimated.inliers).any()


@pytest.mark.parametrize("far", [1e5, 1e7, 1e9, 1e20, 1e30, 1e37])  # the square of the last three overflows
def test_far_points_do_not_make_inliers_of_the_others(far):
    rng = np.random.default_rng(0)
    points1, points0 = rng.uniform(0, SIZE, (2, 60, 2))
    points0[:30] = points1[:30] + 5
    points1[-1], points0[-1] = far, (far, -far)
    matches = make_matches(points0, points1, capacity=CAPACITY)
    for scorer in (Homography(8.0), Homography(8.0, refit=True)):
        estimated = estimate(scorer, matches)
        assert 30 <= float(estimated.score) <= 34
        assert not estimated.inliers[59]


INVERSION = jnp.array([0.0, 0, 1, 0, 1, 0, 1, 0, 0])  # (x, y) -> (1 / x, y / x): the line x = 0 maps to infinity


def test_points_at_infinity_are_no_inliers():
    singular = jnp.array([1.0, 0, 0, 0, 1, 0, 1, 0, 0])  # (0, 0) has no image at all
    points = jnp.array([[0.0, 0, 0.5, 0.5], [0, 0.5, 0.5, 0.5], [0, 0, 0, 0], [2, 1, 0.5, 0.5]])
    for threshold in (0.0, 0.1, 1e30):
        within = jax.jit(homography.is_inlier)(INVERSION, points, jnp.float32(threshold))
        assert within.tolist() == [False, False, False, True]
        assert not homography.is_inlier(singular, points[:3], jnp.float32(threshold)).any()
        both = jnp.stack([INVERSION, singular], axis=1)  # many models and one match
        assert not homography.is_inlier(both, points[0], jnp.float32(threshold)).any()


@pytest.mark.parametrize("start", [INVERSION, jnp.array([1.0, 0, 0, 0, 1, 0, 0.5, 0, 1])])
def test_points_at_infinity_stay_out_of_the_least_squares(start):
    """Without weight; one of them is at infinity in each model, one is padding."""
    rng = np.random.default_rng(0)
    points1 = rng.uniform(0.5, 1, (20, 2))
    points0 = ransac_oracle.mapped(np.asarray(start, float).reshape(3, 3), points1) + rng.normal(0, 0.01, (20, 2))
    at_infinity = [[0, 0.5, 1, 1], [-2, 0, 1, 1], [np.nan] * 4]
    points = jnp.asarray(np.concatenate([np.concatenate([points1, points0], axis=1), at_infinity]), jnp.float32)
    weights = jnp.asarray(np.arange(23) < 20, jnp.float32)
    model = np.asarray(homography.least_squares(start, points, weights), float)
    before, after = (
        np.sum((ransac_oracle.mapped(each.reshape(3, 3), points1) - points0) ** 2)
        for each in (np.asarray(start, float), model)
    )
    assert np.isfinite(model).all()
    assert after < 0.95 * before
    matrix = homography.Frame(jnp.zeros(4), jnp.ones(2)).to_pixels(start)
    assert np.isfinite(matrix).all()


def test_a_match_counts_with_its_confidence():
    matches = pair(10, 60, 1.0, noise=0.5)
    confidence = np.zeros(CAPACITY, np.float32)
    confidence[:60] = np.random.default_rng(0).choice([0.0, 0.25, 1.0], 60)
    assert score(replace(matches, confidence=confidence)) == confidence.sum()
    without = replace(matches, mask=confidence > 0, confidence=np.where(confidence > 0, 1, np.nan).astype(np.float32))
    assert score(without) == (confidence > 0).sum()
    assert score(replace(matches, confidence=np.full(CAPACITY, 2.0**-6, np.float32))) == 60 / 64


@pytest.mark.parametrize(("limit", "numbers"), [("max_iterations", (np.nan, 0.0)), ("confidence", (np.nan, -1.0, 0.0))])
def test_limits_without_meaning_score_nan(limit, numbers):
    assert np.isnan([score(pair(9, 40, 0.5), **{limit: np.float32(number)}) for number in numbers]).all()


@pytest.mark.slow
def test_gradients_raise_but_not_those_of_other_scores():
    matches = pair(11, 20, 0.8)
    with pytest.raises(NoGradientError, match=r"homography: .*gradient"):
        jax.grad(lambda threshold: Homography(threshold)(matches))(8.0)
    with pytest.raises(NoGradientError, match=r"homography: .*gradient"):
        jax.grad(lambda points: Homography()(replace(matches, points0=points)))(matches.points0)
    beside = jax.grad(lambda scores: Homography()(matches) + jnp.sum(masked(scores, matches.mask)))(matches.scores0)
    np.testing.assert_array_equal(beside, matches.mask)
