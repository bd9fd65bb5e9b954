"""The soft form of every scorer: against its float64 loop, between its bounds, and hard in the limit."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    UnitWeight,
    score_grid,
)
from tests import score_oracles
from tests.builders import SIZE, double, make_matches, random_matches, real, stack
from tests.scorers import each_scorer, score

pytestmark = pytest.mark.thorough

HISTOGRAMS = [
    HistogramOfShifts(bin_size=24.0, max_bins=30),
    HistogramOfShifts(24.0, 400.0, UnitWeight(), truncate=2.0, sigma_is_variance=True, max_bins=30),
    HistogramOfShifts(bin_size=24.0, align="zero_center", shift_range=(100.0, 50.0), max_bins=30),
    HistogramOfShifts(bin_size=24.0, align="zero_edge", direction="query_minus_candidate", max_bins=30),
]
ANCHORS = [
    AnchorPoints(5, 4, 2.5),
    AnchorPoints(5, 3, 2.0, window_mode="asymmetric", first="candidate", cell_weight="cell_sum", include_self=False),
    AnchorPoints(5, 4, 1.5, window_mode="odd_down", cell_weight="ones", weight=UnitWeight()),
    AnchorPoints(5, 1, 4.0, window_mode="radius", first="candidate", include_self=False),
]
SUMS = [
    AggregatedScore(),
    AggregatedScore(clamp=True),
    AggregatedScore(mean="weighted", clamp=True),
    AggregatedScore(mean="median", clamp=True),
]


def distinct_matches(rng, count, num_bins=5):
    """Matches without ties: points well inside cells, half of them in the same, and weights that differ."""
    cells0, anywhere = rng.integers(0, num_bins, (2, count, 2))
    cells1 = np.where(rng.random((count, 1)) < 0.5, cells0, anywhere)
    points0, points1 = ((cells + rng.uniform(0.2, 0.8, (count, 2))) * SIZE / num_bins for cells in (cells0, cells1))
    weights = {name: rng.uniform(0.1, 1, count) for name in ("distance", "scores0", "scores1", "confidence")}
    return make_matches(points0, points1, capacity=count + 5, **weights)


def oracle_inputs(scorer, matches):
    points0, points1, distance, scores0, scores1 = real(matches)
    confidence = matches.confidence[matches.mask].astype(float)
    weights = {FeatureScoreWeight: scores0 + scores1, DescriptorDistanceWeight: 2 - distance, UnitWeight: 1.0}
    return points0, points1, weights[type(scorer.weight)] * confidence, confidence


def draws(scorers, temperatures):
    rng = st.integers(0, 2**32 - 1).map(np.random.default_rng)
    matches = st.builds(lambda r, count: random_matches(r, count, capacity=16), rng, st.sampled_from([0, 1, 2, 16]))
    return given(matches, st.sampled_from(scorers), st.sampled_from(temperatures))


@pytest.mark.optimized
@draws(HISTOGRAMS, [1e-6, 0.01, 0.3, 10.0, 1e3])
def test_histogram_agrees_with_the_loop(matches, scorer, temperature):
    points0, points1, weights, _ = oracle_inputs(scorer, matches)
    names = ("bin_size", "sigma", "sigma_is_variance", "truncate", "align", "shift_range")
    options = {name: getattr(scorer, name) for name in names}
    ends = [(points0, matches.image_size0), (points1, matches.image_size1)]
    (start, size0), (end, size1) = ends if scorer.direction == "candidate_minus_query" else ends[::-1]
    expected = score_oracles.histogram_score(end - start, weights, size0, size1, temperature=temperature, **options)
    got = score(replace(scorer, temperature=temperature), matches)
    # Of up to 900 bins: the temperature times a logarithm near 7, in single precision.
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=4e-6 * (1 + temperature))
    hard = score(scorer, matches)
    slack = 1e-6 * (1 + abs(hard) + temperature)
    assert hard - temperature * np.log(900) - slack <= got <= hard + slack


@draws(ANCHORS, [0.02, 0.3, 1.0, 3.0])
def test_anchor_agrees_with_the_loop(matches, scorer, temperature):
    names = ("num_bins", "window", "tolerance", "window_mode", "first", "include_self", "cell_weight")
    options = {name: getattr(scorer, name) for name in names}
    sizes = matches.image_size0, matches.image_size1
    expected = score_oracles.anchor_points(*oracle_inputs(scorer, matches), *sizes, temperature=temperature, **options)
    got = score(replace(scorer, temperature=temperature), matches)
    np.testing.assert_allclose(got, expected, rtol=2e-4, atol=1e-4)


@draws([scorer for scorer in SUMS if scorer.mean != "median"], [0.5, 20.0, 300.0])
def test_aggregate_agrees_with_the_loop(matches, scorer, temperature):
    points0, points1, weights, confidence = oracle_inputs(scorer, matches)
    if confidence.sum() == 0:
        weights = confidence = np.zeros(0)
        points0 = points1 = np.zeros((0, 2))
    expected = score_oracles.aggregated_score(
        points1 - points0,
        weights,
        confidence,
        matches.image_size0,
        temperature=temperature,
        mean=scorer.mean,
        clamp=scorer.clamp,
    )
    np.testing.assert_allclose(score(replace(scorer, temperature=temperature), matches), expected, rtol=2e-5)


@each_scorer(HISTOGRAMS + ANCHORS + SUMS)
@pytest.mark.parametrize("seed", [0, 1])
def test_soft_becomes_hard(scorer, seed):
    """In double precision, where the error is not rounding; hard and soft are two programs, one for all T."""
    with jax.enable_x64(True):
        matches = double(distinct_matches(np.random.default_rng(seed), 25))
        hard = score(scorer, matches)
        cool = [score(replace(scorer, temperature=t), matches) for t in (3e-2, 1e-3, 3e-5, 1e-6)]
    errors = np.abs(np.array(cool) / np.array(hard) - 1)
    assert (np.diff(errors) < 0).all()
    assert errors[-1] < 1e-4


@each_scorer([HISTOGRAMS[0], ANCHORS[0], SUMS[1]])
def test_a_grid_of_temperatures_equals_the_loop_and_is_nan_unless_above_zero(scorer):
    matches, temperatures = random_matches(np.random.default_rng(6), 16), np.array([-1.0, 0.0, 0.1, 0.3, 1.0])
    traced = jax.jit(lambda values: score_grid(replace(scorer, temperature=1), stack([matches]), temperature=values))
    grid = traced(temperatures)
    loop = [score(replace(scorer, temperature=np.float32(t)), matches) for t in temperatures]
    np.testing.assert_allclose(grid[:, 0], loop, rtol=1e-5)
    assert np.isnan(loop).tolist() == [True, True, False, False, False]
