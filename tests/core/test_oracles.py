"""Every scorer against its float64 loop, over random, empty, single, tied and duplicated matches."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    RatioWeight,
    UnitWeight,
)
from tests import oracles
from tests.builders import make_matches, random_matches, real

pytestmark = pytest.mark.thorough

WEIGHTS = {
    "fs": (FeatureScoreWeight(), lambda d, s0, s1, r: s0 + s1),
    "dmf": (DescriptorDistanceWeight(), lambda d, s0, s1, r: 2 - d),
    "ratio": (RatioWeight(), lambda d, s0, s1, r: 1 - r),
    "ratio, squared": (RatioWeight(2.0), lambda d, s0, s1, r: (1 - r) ** 2),
    "unit": (UnitWeight(), lambda d, s0, s1, r: np.ones(len(d))),
}
dominant_shift = jax.jit(HistogramOfShifts.dominant_shift, static_argnames="refine")
CAPACITY = 41  # bins along an axis that all examples need: one shape of arrays for all of them
CLOSE = {"rtol": 2e-5, "atol": 1e-4}  # float32 sums of 60 terms; scores are of order 1 and more


@st.composite
def pairs(draw):
    """Matches of one pair: empty, single, duplicated, tied or random, with weights exact in float32."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sizes = draw(st.sampled_from([((168, 168), (168, 168)), ((240, 160), (168, 200)), ((168, 200), (176, 169))]))
    matches = random_matches(rng, draw(st.sampled_from([0, 1, 2, 5, 20, 60])), capacity=64, sizes=sizes)
    mask = matches.mask
    if draw(st.booleans()):  # ties: few places, equal weights
        for points in (matches.points0, matches.points1):
            points[mask] = rng.integers(0, 4, (mask.sum(), 2)) * 42 + 21.0
        for values in (matches.distance, matches.scores0, matches.scores1, matches.ratio):
            values[mask] = 0.5
    if draw(st.booleans()):  # duplicates
        matches.points0[mask] = matches.points0[0]
        matches.points1[mask] = matches.points1[0]
    return matches if draw(st.booleans()) else replace(matches, confidence=None)


def certainty(matches):
    """Confidence of the real matches."""
    return np.ones(matches.mask.sum()) if matches.confidence is None else matches.confidence[matches.mask].astype(float)


def oracle_inputs(matches, weight):
    """Points and weights of the matches with any confidence."""
    points0, points1, distance, scores0, scores1 = real(matches)
    confidence = certainty(matches)
    ratio = None if matches.ratio is None else matches.ratio[matches.mask].astype(float)
    weights = WEIGHTS[weight][1](distance, scores0, scores1, ratio) * confidence
    return tuple(values[confidence > 0] for values in (points0, points1, weights))


@pytest.mark.parametrize("align", ["min_edge", "zero_center", "zero_edge"])
@given(
    matches=pairs(),
    weight=st.sampled_from(list(WEIGHTS)),
    parameters=st.sampled_from([(15.0, 22.5), (20.0, 8.0), (11.0, 30.0), (48.0, 5.0)]),
    truncate=st.sampled_from([np.inf, 2.0]),
    shift_range=st.sampled_from([None, (100.0, 40.0)]),
    variance=st.booleans(),
    direction=st.sampled_from(["candidate_minus_query", "query_minus_candidate"]),
)
@settings(max_examples=20)
def test_histogram(matches, weight, align, parameters, truncate, shift_range, variance, direction):
    bin_size, sigma = parameters
    scorer = HistogramOfShifts(
        bin_size=bin_size,
        sigma=sigma,
        truncate=truncate,
        align=align,
        shift_range=shift_range,
        sigma_is_variance=variance,
        direction=direction,
        weight=WEIGHTS[weight][0],
        max_bins=CAPACITY,
    )
    points0, points1, weights = oracle_inputs(matches, weight)
    ends = [(points0, matches.image_size0), (points1, matches.image_size1)]
    (start, size0), (end, size1) = ends if direction == "candidate_minus_query" else ends[::-1]
    expected, centers_x, centers_y = oracles.histogram_of_shifts(
        end - start,
        weights,
        size0,
        size1,
        bin_size=bin_size,
        sigma=sigma,
        truncate=truncate * (1 + 1e-6),
        align=align,
        shift_range=shift_range,
        sigma_is_variance=variance,
    )
    got = scorer.histogram(matches)
    rows, columns = expected.shape
    assert scorer.with_capacity(matches.image_size0, matches.image_size1).max_bins == max(expected.shape)
    np.testing.assert_allclose(got.centers_x[:columns], centers_x, atol=1e-3)
    np.testing.assert_allclose(got.centers_y[:rows], centers_y, atol=1e-3)
    np.testing.assert_allclose(got.scores[:rows, :columns], expected, **CLOSE)
    assert np.isneginf(got.scores).sum() == CAPACITY**2 - expected.size
    np.testing.assert_allclose(scorer(matches), expected.max() if len(weights) else 0.0, **CLOSE)


@pytest.mark.parametrize("cell_weight", ["winner_sum", "cell_sum", "ones"])
@given(
    matches=pairs(),
    weight=st.sampled_from(list(WEIGHTS)),
    parameters=st.sampled_from([(10, 3.0), (9, 1.0), (2, 4.5), (15, 2.0)]),
    window_mode=st.sampled_from(["half_floor", "asymmetric", "odd_down", "radius"]),
    first=st.sampled_from(["query", "candidate"]),
    include_self=st.booleans(),
    num_bins=st.sampled_from([15, 4]),
)
@settings(max_examples=20)
def test_anchor(matches, weight, parameters, window_mode, first, include_self, cell_weight, num_bins):
    window, tolerance = parameters
    options = {
        "window": window,
        "tolerance": tolerance,
        "window_mode": window_mode,
        "first": first,
        "include_self": include_self,
        "cell_weight": cell_weight,
        "num_bins": num_bins,
    }
    points0, points1, weights = oracle_inputs(matches, weight)
    expected = oracles.anchor_points(points0, points1, weights, matches.image_size0, matches.image_size1, **options)
    got = AnchorPoints(weight=WEIGHTS[weight][0], **options)(matches)
    np.testing.assert_allclose(got, expected, **CLOSE)


@pytest.mark.parametrize("mean", ["unweighted", "weighted", "median"])
@given(matches=pairs(), weight=st.sampled_from(list(WEIGHTS)), clamp=st.booleans())
def test_aggregate(matches, weight, mean, clamp):
    points0, points1, weights = oracle_inputs(matches, weight)
    confidence = certainty(matches)
    expected = oracles.aggregated_score(
        points1 - points0, weights, matches.image_size0, mean=mean, clamp=clamp, confidence=confidence[confidence > 0]
    )
    got = AggregatedScore(weight=WEIGHTS[weight][0], mean=mean, clamp=clamp)(matches)
    np.testing.assert_allclose(got, expected, rtol=2e-5)


@given(pairs(), st.sampled_from([(15.0, 22.5), (20.0, 8.0)]))
def test_dominant_shift(matches, sizes):
    bin_size, sigma = sizes
    points0, points1, weights = oracle_inputs(matches, "fs")
    scorer = HistogramOfShifts(bin_size=bin_size, sigma=sigma, max_bins=CAPACITY)
    shift = np.asarray(dominant_shift(scorer, matches))
    if not len(weights):
        np.testing.assert_array_equal([shift, dominant_shift(scorer, matches, refine=True)], 0)
        return
    histogram, centers_x, centers_y = oracles.histogram_of_shifts(
        points1 - points0, weights, matches.image_size0, matches.image_size1, bin_size=bin_size, sigma=sigma
    )
    column, row = np.argmin(abs(centers_x - shift[0])), np.argmin(abs(centers_y - shift[1]))
    np.testing.assert_allclose([centers_x[column], centers_y[row]], shift, atol=1e-3)
    np.testing.assert_allclose(histogram[row, column], histogram.max(), rtol=1e-5)  # rounding may choose among equals


@given(pairs(), st.sampled_from([(15.0, 22.5), (20.0, 8.0)]), st.sampled_from([(0.68, 24.0), (0.95, 3.0)]))
@settings(max_examples=25)
def test_shift_interval_is_the_middle_of_the_mass(matches, sizes, mass):
    bin_size, sigma = sizes
    level, sharpness = mass
    points0, points1, weights = oracle_inputs(matches, "fs")
    scorer = HistogramOfShifts(bin_size=bin_size, sigma=sigma, max_bins=CAPACITY)
    interval = np.asarray(scorer.shift_interval(matches, level=level, sharpness=sharpness))
    assert (interval[0] < interval[1]).all()
    if not len(weights):
        return
    histogram, *centers = oracles.histogram_of_shifts(
        points1 - points0, weights, matches.image_size0, matches.image_size1, bin_size=bin_size, sigma=sigma
    )
    mass = (histogram / histogram.max()) ** sharpness if histogram.max() > 0 else np.ones_like(histogram)
    for axis in (0, 1):
        along = mass.sum(axis=axis) / mass.sum()
        for edge, share in zip(interval[:, axis], ((1 - level) / 2, (1 + level) / 2), strict=True):
            below = 0.0  # of the mass before the edge, a part of the bin that it is in
            for center, part in zip(centers[axis], along, strict=True):
                below += part * min(max((edge - center) / bin_size + 0.5, 0), 1)
            assert below == pytest.approx(share, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_refined_shift_is_the_mode_of_the_votes(seed):
    rng = np.random.default_rng(seed)
    points0 = rng.uniform(60, 270, (50, 2))
    points1 = points0 + rng.uniform(-50, 50, 2) + rng.normal(0, 4, (50, 2))
    matches = make_matches(points0, points1, scores0=rng.uniform(0.2, 1, 50), scores1=rng.uniform(0.2, 1, 50))
    points0, points1, weights = oracle_inputs(matches, "fs")
    scorer = HistogramOfShifts(max_bins=45)
    refined = np.asarray(dominant_shift(scorer, matches, refine=True), float)
    density = lambda s: np.sum(weights * np.exp(-np.sum((points1 - points0 - s) ** 2, axis=1) / (2 * 22.5**2)))  # noqa: E731
    assert density(refined) >= scorer(matches)
    for step in ([4e-3, 0], [-4e-3, 0], [0, 4e-3], [0, -4e-3]):
        assert density(refined) > density(refined + step)
