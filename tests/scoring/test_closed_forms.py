"""Closed forms and invariances that need no oracle."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import AggregatedScore, AnchorPoints, HistogramOfShifts, UnitWeight
from mfvpr.utils import InputError
from tests.builders import SIZE, make_matches, random_matches
from tests.scoring.batches import score

pytestmark = pytest.mark.thorough

histogram = jax.jit(HistogramOfShifts.histogram)
dominant_shift = jax.jit(HistogramOfShifts.dominant_shift, static_argnames="refine")
CENTER = -SIZE + 7.5 + 15 * 24  # the center of bin 24 along an axis: 31.5 px


def grid_points(num_bins=15):
    """One point in the middle of every anchor cell."""
    middle = (np.arange(num_bins) + 0.5) * SIZE / num_bins
    return np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("count", [1, 2, 17])
def test_coincident_matches_at_a_bin_center_score_their_weight(count):
    points0 = np.full((count, 2), 100.0)
    matches = make_matches(points0, points0 + CENTER, scores0=np.full(count, 0.75), scores1=np.full(count, 1.5),
                           capacity=17)  # fmt: skip
    assert HistogramOfShifts()(matches) == pytest.approx(2.25 * count, rel=1e-6)
    np.testing.assert_allclose(HistogramOfShifts().dominant_shift(matches), [CENTER, CENTER])


@pytest.mark.parametrize("size, bins", [(336, 45), (320, 43)])
def test_number_of_bins_of_the_paper(size, bins):
    matches = make_matches([[1, 1]], [[2, 2]], sizes=((size, size), (size, size)))
    assert HistogramOfShifts().histogram(matches).scores.shape == (bins, bins)


def test_a_match_votes_for_bins_as_far_as_the_limit():
    matches = make_matches([[100, 100]], [[100 + CENTER, 100 + CENTER]], scores0=[0.5], scores1=[0.5])
    scores = np.asarray(histogram(HistogramOfShifts(sigma=10.0, truncate=1.5, max_bins=63), matches).scores)
    vote = np.exp(-0.5 * 1.5**2)
    np.testing.assert_allclose(scores[23:26, 22:27], np.outer([vote, 1, vote], [0, vote, 1, vote, 0]), rtol=1e-6)


def test_matches_agree_within_two_deviations_along_both_axes():
    shifts = np.array([[0, 0], [45, 0], [45.1, 0], [0, -45], [0, -45.1], [44, 44]])
    matches = make_matches(np.full((6, 2), 100.0), 100 + shifts)
    agreement = HistogramOfShifts(sigma=22.5).agrees(matches, np.zeros(2, np.float32))
    assert agreement.tolist() == [True, True, False, True, False, True]


def test_tiny_sigma_is_the_hard_histogram_of_zhang():
    rng = np.random.default_rng(1)
    shifts = CENTER + 15 * rng.integers(-2, 3, (50, 2))
    matches = make_matches(np.full((50, 2), 120.0), 120 + shifts)
    _, counts = np.unique(shifts, axis=0, return_counts=True)
    assert HistogramOfShifts(sigma=0.5, weight=UnitWeight())(matches) == pytest.approx(counts.max())


SCALES = (0.7, 0.84, 1.0, 1.19, 1.41)


@pytest.mark.parametrize("scale", SCALES)
def test_a_zoom_costs_nothing_at_its_scale(scale):
    """Points of a candidate that shows the place so many times as large, moved: all votes meet again."""
    rng = np.random.default_rng(4)
    sizes, shift = ((336, 320), (300, 336)), np.array([18.0, -7.0])
    center0, center1 = (np.array(size) / 2 for size in sizes)
    points0 = center0 + rng.uniform(-80, 80, (50, 2))
    points1 = center1 + scale * (points0 - center0) + np.sqrt(scale) * shift
    scores = {"scores0": rng.uniform(0.1, 1, 50), "scores1": rng.uniform(0.1, 1, 50)}
    matches = make_matches(points0, points1, sizes=sizes, **scores)
    pure = make_matches(points0, points0 + center1 - center0 + shift, sizes=sizes, **scores)
    scorer = HistogramOfShifts(scales=SCALES)
    assert float(scorer(matches)) == pytest.approx(float(HistogramOfShifts()(pure)), rel=1e-5)
    assert float(scorer.dominant_scale(matches)) == pytest.approx(scale)
    refined = scorer.dominant_shift(matches, refine=True)
    np.testing.assert_allclose(refined, center1 - center0 + shift, atol=1e-3)
    assert np.asarray(scorer.agrees(matches, refined)).all()
    if scale != 1:
        assert float(HistogramOfShifts()(matches)) < 0.95 * float(scorer(matches))


def test_scales_are_votes_of_zoomed_points_and_the_prior_is_a_factor():
    matches = random_matches(np.random.default_rng(5), 60)
    center0, center1 = (np.asarray(size) / 2 for size in (matches.image_size0, matches.image_size1))
    by_scale = []
    for scale in SCALES:
        points0 = center0 + (matches.points0 - center0) * np.sqrt(scale)
        points1 = center1 + (matches.points1 - center1) / np.sqrt(scale)
        by_scale.append(float(HistogramOfShifts()(replace(matches, points0=points0, points1=points1))))
    assert float(HistogramOfShifts(scales=SCALES)(matches)) == pytest.approx(max(by_scale), rel=1e-5)
    likely = np.exp(-(np.log2(SCALES) ** 2) / (2 * 0.3**2))
    scorer = HistogramOfShifts(scales=SCALES, scale_deviation=0.3)
    assert float(scorer(matches)) == pytest.approx(max(likely * by_scale), rel=1e-5)
    assert float(scorer.dominant_scale(matches)) == pytest.approx(SCALES[np.argmax(likely * by_scale)])
    np.testing.assert_allclose(scorer.histogram(matches).scores.max(), scorer(matches), rtol=1e-5)
    smallest = HistogramOfShifts(scales=SCALES[:1], scale_deviation=0.3)
    assert float(smallest(matches)) == pytest.approx(likely[0] * by_scale[0], rel=1e-5)


@pytest.mark.parametrize(("seed", "scales"), [(2, (1.0,)), (6, (0.5, 1.0, 2.0))])
def test_exchanged_images_mirror_the_histogram_when_a_bin_is_centered_on_zero(seed, scales):
    """Scales become their inverses."""
    matches = random_matches(np.random.default_rng(seed), 60)
    exchanged = replace(matches, points0=matches.points1, points1=matches.points0)
    scorer = HistogramOfShifts(align="zero_center", scales=scales)
    assert float(scorer(exchanged)) == pytest.approx(float(scorer(matches)), rel=1e-5)
    assert float(scorer.dominant_scale(exchanged)) == pytest.approx(1 / float(scorer.dominant_scale(matches)))
    mirrored = scorer.histogram(matches).scores[::-1, ::-1]
    np.testing.assert_allclose(scorer.histogram(exchanged).scores, mirrored, rtol=1e-4, atol=1e-5)
    reverse = replace(scorer, direction="query_minus_candidate")
    np.testing.assert_allclose(reverse.dominant_shift(matches), -scorer.dominant_shift(matches), atol=1e-3)


def test_a_histogram_beyond_its_capacity_is_nan_not_wrong():
    matches = random_matches(np.random.default_rng(3), 30)
    small, tight, loose = (HistogramOfShifts(max_bins=bins) for bins in (44, 45, 80))
    assert np.isnan(score(small, matches))
    assert np.isnan(dominant_shift(small, matches)).all()
    assert np.isnan(dominant_shift(small, matches, refine=True)).all()
    assert np.isfinite(score(tight, matches))
    np.testing.assert_allclose(score(tight, matches), score(loose, matches), rtol=1e-6)


@pytest.mark.parametrize("include_self", [True, False])
def test_identical_images_give_the_full_window_to_every_anchor(include_self):
    points = grid_points()
    matches = make_matches(points, points)
    row = np.arange(15)
    reach = (abs(row[:, None] - row) <= 5).sum(1)  # cells of the 11-wide window inside the grid, along one axis
    cells = reach[:, None] * reach - (not include_self)
    assert AnchorPoints(include_self=include_self)(matches) == pytest.approx(3.0 * 1.0 * cells.sum(), rel=1e-6)


def test_tolerance_one_counts_exact_agreements_as_ssm_vpr():
    cell = np.stack(np.divmod(np.arange(225), 15)[::-1], axis=-1)
    target = np.clip(cell + np.random.default_rng(4).integers(0, 3, (225, 2)), 0, 14)
    matches = make_matches(grid_points(), (target + 0.5) * SIZE / 15)
    displacement = target - cell
    near = (abs(cell[:, None] - cell) <= 5).all(-1)
    agreements = (near & (displacement[:, None] == displacement).all(-1)).sum()
    assert float(AnchorPoints(tolerance=1.0, cell_weight="ones")(matches)) == agreements


def test_equal_shifts_give_the_aggregated_score_its_maximum():
    points0 = np.random.default_rng(5).uniform(0, 200, (40, 2)).round()
    distance = np.linspace(0, 2, 40)
    matches = make_matches(points0, points0 + [30, -7], distance=distance, sizes=((320, 240), (320, 240)))
    assert AggregatedScore()(matches) == pytest.approx((2 - distance).sum() * (320**2 + 240**2), rel=1e-5)


def test_a_bin_size_below_0_raises():
    with pytest.raises(ValueError, match="bin_size=-5"):
        HistogramOfShifts(bin_size=-5.0)(random_matches(np.random.default_rng(6), 30))


def test_a_histogram_without_votes_has_no_shift():
    matches = make_matches([[10, 10]], [[50, 20]], scores0=[0.0], scores1=[0.0])
    np.testing.assert_array_equal(HistogramOfShifts().dominant_shift(matches), 0)


@pytest.mark.parametrize(
    ("count", "align"),
    [case for count in (15, 29, 30, 31, 58, 60)
     for case in ((count, "min_edge"), (count, "zero_center" if count % 2 else "zero_edge"))],
)  # fmt: skip
def test_rounding_adds_no_bin_that_holds_nothing(count, align):
    """Bins that tile the range exactly, in widths that binary fractions only approximate."""
    scorer = HistogramOfShifts(bin_size=2 * SIZE / count, align=align)
    matches = make_matches([[10, 10]], [[20, 20]])
    assert scorer.with_capacity(matches.image_size0, matches.image_size1).max_bins == count
    bins = histogram(replace(scorer, max_bins=63), matches)
    assert int((bins.scores > -np.inf).any(axis=0).sum()) == count
    np.testing.assert_allclose(bins.centers_x[0], -SIZE + SIZE / count, rtol=1e-5)


def test_interval_of_equal_shifts_is_that_of_a_gaussian_and_holds_two_peaks_where_there_are_two():
    points = np.full((12, 2), 150.0)
    scorer = HistogramOfShifts(bin_size=1.0, sigma=24.0)
    low, high = scorer.shift_interval(make_matches(points, points + [30, -7]), sharpness=16.0)
    np.testing.assert_allclose([low, high], np.add([30, -7], [[-1.96 * 6], [1.96 * 6]]), atol=0.05)
    shifts = np.where(np.arange(12)[:, None] % 2, [60, 0], [-60, 0])
    low, high = scorer.shift_interval(make_matches(points, points + shifts))
    assert low[0] < -60 < 60 < high[0]
    assert -12 < low[1] < 0 < high[1] < 12


def test_interval_where_nothing_votes_is_of_all_shifts_and_too_few_bins_have_none():
    matches, empty = random_matches(np.random.default_rng(0), 20), make_matches([], [])
    low, high = HistogramOfShifts(bin_size=1.0).shift_interval(empty, level=0.5)
    np.testing.assert_allclose([low, high], [[-SIZE / 2] * 2, [SIZE / 2] * 2], atol=1)
    small = jax.jit(lambda matches: HistogramOfShifts(max_bins=8).shift_interval(matches))
    assert np.isnan(small(matches)).all()
    with pytest.raises(InputError, match="level=95: expected a number between 0 and 1"):
        HistogramOfShifts().shift_interval(matches, level=95)
