"""The histogram with every option, in grids and pair by pair; its smooth maximum, and the peak between bins."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    UnitWeight,
    score_candidates,
    score_grid,
)
from mfvpr.core.histogram import climb, smooth_maximum
from mfvpr.utils import InputError
from tests.builders import SIZE, make_matches, random_matches, stack

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def matches():
    rng = np.random.default_rng(0)
    sizes = [((336, 336), (336, 336)), ((320, 240), (336, 200)), ((200, 300), (336, 336)), ((336, 336), (90, 30))]
    cases = zip((60, 0, 1, 33), sizes, strict=True)
    return stack([random_matches(rng, count, capacity=60, sizes=of_pair) for count, of_pair in cases])


OPTIONS = [
    {},
    {"align": "zero_center", "truncate": 2.0},
    {"align": "zero_edge", "shift_range": (100.0, 40.0)},
    {"direction": "query_minus_candidate", "sigma_is_variance": True},
    {"weight": DescriptorDistanceWeight(), "max_bins": 140},
    {"temperature": 0.3},
    {"weight": UnitWeight()},
]


@pytest.mark.first_case
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_grid_equals_pair_by_pair(matches, options):
    """Every option, pairs of different sizes, searched (5 px) and whole (15 px), empty and single pairs."""
    matches = replace(matches, confidence=None) if "weight" in options else matches
    scorer, sigmas, bin_sizes = HistogramOfShifts(**options), [4.0, 30.0], [5.0, 15.0]
    got = score_grid(scorer, matches, sigma=sigmas, bin_size=bin_sizes)
    for sigma, row in zip(sigmas, got, strict=True):
        scorers = [replace(scorer, sigma=sigma, bin_size=bin_size, max_bins=144) for bin_size in bin_sizes]
        expected = [score_candidates(scorer, matches) for scorer in scorers]
        np.testing.assert_allclose(row, expected, rtol=2e-6, atol=1e-6)


def test_a_weight_that_is_no_number_spoils_its_own_score_only(matches):
    spoiled = replace(matches, scores0=np.where(matches.mask, np.nan, matches.scores0))
    got = score_grid(HistogramOfShifts(bin_size=5.0), spoiled, weight=[FeatureScoreWeight(), UnitWeight()])
    expected = score_candidates(HistogramOfShifts(bin_size=5.0, weight=UnitWeight()), matches)
    np.testing.assert_allclose(got[1], expected, rtol=2e-6)
    np.testing.assert_array_equal(got[0], [np.nan, 0.0, np.nan, np.nan])


@pytest.mark.parametrize(
    "options",
    [{"bin_size": size, "max_bins": 136} for size in (0.0, -5.0, np.nan)]
    + [{"shift_range": (-5.0, 5.0), "align": "zero_center"}, {"truncate": np.nan}, {"sigma": 0.0}, {"sigma": -5.0}],
    ids=str,
)
def test_numbers_without_meaning_score_nan(matches, options):
    """Traced, where nothing can raise; XLA's maximum over thousands of bins on a CPU would skip NaN."""
    traced = {name: np.asarray(number) for name, number in options.items() if isinstance(number, float | tuple)}
    scorer = HistogramOfShifts(**{"max_bins": 45} | {name: options[name] for name in options if name not in traced})
    got = jax.jit(lambda traced: score_candidates(replace(scorer, **traced), matches))(traced)
    np.testing.assert_array_equal(np.isnan(got), matches.mask.any(1))


def test_matches_agree_within_two_deviations_along_both_axes():
    shifts = np.array([[0, 0], [45, 0], [45.1, 0], [0, -45], [0, -45.1], [44, 44]])
    matches = make_matches(np.full((6, 2), 100.0), 100 + shifts)
    agreement = HistogramOfShifts(sigma=22.5).agrees(matches, np.zeros(2, np.float32))
    assert agreement.tolist() == [True, True, False, True, False, True]


def test_exchanged_images_mirror_the_histogram_when_a_bin_is_centered_on_zero():
    matches = random_matches(np.random.default_rng(2), 60)
    exchanged = replace(matches, points0=matches.points1, points1=matches.points0)
    scorer = HistogramOfShifts(align="zero_center")
    assert float(scorer(exchanged)) == pytest.approx(float(scorer(matches)), rel=1e-5)
    mirrored = scorer.histogram(matches).scores[::-1, ::-1]
    np.testing.assert_allclose(scorer.histogram(exchanged).scores, mirrored, rtol=1e-4, atol=1e-5)
    reverse = replace(scorer, direction="query_minus_candidate")
    np.testing.assert_allclose(reverse.dominant_shift(matches), -scorer.dominant_shift(matches), atol=1e-3)


@pytest.mark.parametrize(
    ("count", "align"),
    [
        case
        for count in (15, 29, 30, 31, 58, 60)
        for case in ((count, "min_edge"), (count, "zero_center" if count % 2 else "zero_edge"))
    ],
)
def test_rounding_adds_no_bin_that_holds_nothing(count, align):
    """Bins that tile the range exactly, in widths that binary fractions only approximate."""
    scorer = HistogramOfShifts(bin_size=2 * SIZE / count, align=align)
    matches = make_matches([[10, 10]], [[20, 20]])
    assert scorer.with_capacity(matches.image_size0, matches.image_size1).max_bins == count
    bins = jax.jit(HistogramOfShifts.histogram)(replace(scorer, max_bins=63), matches)
    assert int((bins.scores > -np.inf).any(axis=0).sum()) == count
    np.testing.assert_allclose(bins.centers_x[0], -SIZE + SIZE / count, rtol=1e-5)


def test_interval_where_nothing_votes_is_of_all_shifts_and_too_few_bins_have_none():
    matches, empty = random_matches(np.random.default_rng(0), 20), make_matches([], [])
    low, high = HistogramOfShifts(bin_size=1.0).shift_interval(empty, level=0.5)
    np.testing.assert_allclose([low, high], [[-SIZE / 2] * 2, [SIZE / 2] * 2], atol=1)
    small = jax.jit(lambda matches: HistogramOfShifts(max_bins=8).shift_interval(matches))
    assert np.isnan(small(matches)).all()
    with pytest.raises(InputError, match="level=95: expected a number between 0 and 1"):
        HistogramOfShifts().shift_interval(matches, level=95)


SIGMA = np.float32(8)


def fields(count):
    """`[count, ...]` starts at the highest of points 2.2 sigma apart, shifts, weights: few votes or many, clusters."""
    rng = np.random.default_rng(0)
    number = rng.choice([2, 3, 5, 20, 60], count)
    weights = np.where(np.arange(60) < number[:, None], rng.uniform(0.1, 1, (count, 60)), 0)
    reach = SIGMA * rng.choice([2, 6], (count, 1, 1))
    cluster = rng.uniform(-1, 1, (count, 1, 2)) * reach + rng.normal(0, 0.7 * SIGMA, (count, 60, 2))
    shifts = np.where(rng.random((count, 60, 1)) < 0.5, cluster, rng.uniform(-1, 1, (count, 60, 2)) * reach)
    axis = np.arange(-48, 49, 2.2 * SIGMA)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    offsets = shifts[:, None] - grid[None, :, None]
    heights = np.sum(weights[:, None] * np.exp(-0.5 * np.sum((offsets / SIGMA) ** 2, -1)), -1)
    return grid[heights.argmax(1)].astype(np.float32), shifts.astype(np.float32), weights.astype(np.float32)


def landscape(shift, shifts, weights):
    """Heights, slopes in sigmas, and curvatures of many sums of votes, relative to their heights."""
    scaled = (shifts - np.asarray(shift, np.float64)[:, None]) / SIGMA
    pull = weights * np.exp(-0.5 * np.sum(scaled**2, -1))
    height = pull.sum(1)
    pull = pull / height[:, None]
    curvature = np.einsum("nk,nki,nkj->nij", pull, scaled, scaled) - np.eye(2)
    return height, np.einsum("nk,nki->ni", pull, scaled), curvature


def test_the_peak_is_the_maximum_to_a_ten_thousandth_of_sigma():
    start, shifts, weights = fields(400)
    peak = jax.jit(jax.vmap(climb, in_axes=(0, 0, 0, None)))(start, shifts, weights, SIGMA)
    height, slope, curvature = landscape(peak, shifts, weights)
    assert (height >= (1 - 1e-6) * landscape(start, shifts, weights)[0]).all()
    assert np.linalg.eigvalsh(curvature).max() < 0
    left = np.linalg.solve(curvature, slope[..., None])[..., 0]
    assert np.linalg.norm(left, axis=1).max() < 1e-4


def test_derivatives_of_the_peak():
    """The first and the second along one direction of shifts, weights and sigma, beside differences of peaks."""
    start, shifts, weights = (values[0].astype(float) for values in fields(5))
    way, more = np.random.default_rng(1).normal(size=(2, 60))

    def peak(step):
        return climb(start, shifts + step * way[:, None], weights * (1 + step * more), float(SIGMA) * (1 + step))[0]

    steps = np.array([-1e-3, 0, 1e-3])
    with jax.enable_x64(True):
        slope = jax.grad(peak)
        peaks, slopes, bends = jax.jit(jax.vmap(lambda step: (peak(step), slope(step), jax.grad(slope)(step))))(steps)
    np.testing.assert_allclose(slopes[1], np.gradient(peaks, steps)[1], rtol=1e-4)
    np.testing.assert_allclose(bends[1], np.gradient(slopes, steps)[1], rtol=1e-4)


@pytest.mark.parametrize("peak", [3.0, 100.0])
def test_the_smooth_maximum_has_the_digits_of_float32_at_any_temperature(peak):
    rng = np.random.default_rng(0)
    values = rng.exponential(1e-3, (48, 48))
    values[5, 7:9] = peak, 0.7 * peak
    values, mask = np.float32(values), np.arange(48) < 40
    mask = mask[:, None] & mask
    smooth = jax.jit(jax.value_and_grad(lambda values, t: smooth_maximum(values, mask, temperature=t)))
    for temperature in np.geomspace(0.01, 1e4, 60).astype(np.float32):
        ratios = values[mask].astype(np.float64) / temperature
        powers = np.exp(ratios - ratios.max())
        expected = (
            np.log1p(np.expm1(ratios).mean()) if abs(ratios).max() < 500 else ratios.max() + np.log(powers.mean())
        )
        score, slopes = smooth(values, temperature)
        np.testing.assert_allclose(score, temperature * expected, rtol=1e-5)
        np.testing.assert_allclose(slopes[mask], powers / powers.sum(), rtol=3e-5, atol=1e-30)
        assert not np.asarray(slopes)[~mask].any()
