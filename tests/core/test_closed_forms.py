"""Closed forms and invariances that need no oracle."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from mfvpr import HistogramOfShifts
from mfvpr.utils import InputError
from tests.builders import SIZE, make_matches, random_matches

pytestmark = pytest.mark.thorough

histogram = jax.jit(HistogramOfShifts.histogram)


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


def test_a_bin_size_below_0_raises():
    with pytest.raises(ValueError, match="bin_size=-5"):
        HistogramOfShifts(bin_size=-5.0)(random_matches(np.random.default_rng(6), 30))


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
    bins = histogram(replace(scorer, max_bins=63), matches)
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
