"""Grids of parameters against scores of their combinations, one by one."""

import itertools
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mfvpr import (
    AggregatedScore,
    AnchorPoints,
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    HistogramOfShifts,
    InputError,
    MatchCount,
    UnitWeight,
    filter_matches,
    score_candidates,
    score_grid,
)
from mfvpr.core import batch as batch_module
from mfvpr.core import histogram
from mfvpr.core.batch import by_capacity
from tests.builders import random_matches, stack
from tests.scorers import Strongest, Wrapped
from tests.shapes import unchecked_shapes

pytestmark = pytest.mark.thorough


def random_pairs(counts, **options):
    rng = np.random.default_rng(0)
    return stack([random_matches(rng, count, **options) for count in counts])


@pytest.fixture
def matches():
    return random_pairs((40, 0, 12), capacity=40)


@pytest.mark.parametrize(
    ("scorer", "axes", "rtol"),
    [
        (AnchorPoints, {"window": [2, 10], "tolerance": [1.0, 3.0, 4.5]}, 2e-6),
        (AnchorPoints, {"temperature": [0.1, 0.5]}, 2e-6),
        (Strongest, {"place": [0, 1, 3]}, 1e-7),  # whole numbers stay whole
    ],
)
def test_grids_equal_the_loop(matches, scorer, axes, rtol):
    scores = score_grid(scorer(), matches, **axes)
    settings = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    expected = [score_candidates(scorer(**setting), matches) for setting in settings]
    assert scores.shape == (*map(len, axes.values()), 3)
    np.testing.assert_allclose(scores.reshape(-1, 3), expected, rtol=rtol)


def test_axes_keep_their_order(matches):
    """Though distances are varied within each setting of the scorer."""
    axes = {"max_distance": [0.7, 1.5], "window": [2, 6, 10], "tolerance": [1.0, 2.0, 3.0, 4.5]}
    scores, names = score_grid(AnchorPoints(), matches, **axes), list(axes)
    assert scores.shape == (2, 3, 4, 3)
    for order in ((1, 0, 2), (1, 2, 0), (2, 0, 1)):  # the latter two are not their own inverse
        other = score_grid(AnchorPoints(), matches, **{names[place]: axes[names[place]] for place in order})
        np.testing.assert_array_equal(other, np.transpose(scores, (*order, 3)))


@pytest.mark.parametrize("cores", [2, 3])
def test_every_candidate_is_scored_once_by_parts_that_overlap(cores, monkeypatch):
    monkeypatch.setattr(batch_module, "available_cpus", lambda: cores)
    pairs = random_pairs(np.random.default_rng(1).integers(0, 9, 13), capacity=8)
    scores = score_grid(MatchCount(), replace(pairs, confidence=None), max_distance=[0.7, 1.5])
    np.testing.assert_array_equal(scores, [(pairs.mask & (pairs.distance <= limit)).sum(1) for limit in (0.7, 1.5)])


@pytest.mark.first_case
@pytest.mark.parametrize("chunk", [1, 10**5, 2**29])
@pytest.mark.parametrize("temperature", [None, 0.5])
def test_accelerators_score_settings_and_pairs_together(chunk, temperature, monkeypatch):
    pairs, scorer = random_pairs((9, 0, 5), capacity=9), HistogramOfShifts(temperature=temperature)
    axes = {"sigma": [9.0, 20.0, 31.0, 40.0], "weight": ["dmf", "unit"]}
    expected = score_grid(scorer, pairs, **axes)
    jax.clear_caches()
    monkeypatch.setattr(histogram, "CHUNK", chunk)
    for module in (batch_module, histogram):
        monkeypatch.setattr(module, "device_of", lambda _: SimpleNamespace(platform="gpu"))
    np.testing.assert_allclose(score_grid(scorer, pairs, **axes), expected, rtol=1e-6)


def test_kinds_of_weights_and_distances_are_axes_too(matches):
    weights = [FeatureScoreWeight(), DescriptorDistanceWeight(), UnitWeight()]
    got = score_grid(AggregatedScore(), matches, max_distance=[0.7, 1.5], weight=weights)
    for i, limit in enumerate((0.7, 1.5)):
        near = jax.vmap(partial(filter_matches, max_distance=limit))(matches)
        for j, weight in enumerate(weights):
            expected = score_candidates(AggregatedScore(weight=weight), near)
            np.testing.assert_allclose(got[i, j], expected, rtol=2e-6)
    words = score_grid(AggregatedScore(), matches, max_distance=[0.7, 1.5], weight=["fs", "dmf", "unit"])
    np.testing.assert_array_equal(words, got)
    any_distance = score_grid(AggregatedScore(), matches, max_distance=[0.7, None], weight=["fs"])
    np.testing.assert_allclose(any_distance[1, 0], score_candidates(AggregatedScore(weight=weights[0]), matches), 2e-6)


@pytest.mark.parametrize("forgets", [lambda matches: matches.distance, lambda matches: matches.distance[:1]])
def test_a_score_that_is_no_number_is_refused(matches, forgets):
    for call in (score_candidates, partial(score_grid, max_distance=[0.7, 1.5])):
        with (
            unchecked_shapes(),
            pytest.raises(InputError, match=r"expected a number for each of \d+ pairs, got an array"),
        ):
            call(forgets, matches)


def test_fine_bins_do_not_tax_coarse_ones(matches):
    """One program per capacity, each no larger than its bins ask for."""
    sizes = matches.image_size0, matches.image_size1
    groups = by_capacity(HistogramOfShifts(), {"bin_size": np.array([6.0, 14.0, 15.0])}, 3, *sizes)
    needed = [HistogramOfShifts(bin_size=size).with_capacity(*sizes).max_bins for size in (6.0, 14.0, 15.0)]
    assert [list(rows) for _, rows in groups] == [[0], [1, 2]]
    for scorer, rows in groups:
        worst = max(needed[row] for row in rows)
        assert worst <= scorer.max_bins < worst + 8


@pytest.mark.parametrize(
    "scorer, axes, words",
    [
        (HistogramOfShifts(), {"sgma": [1.0]}, "sigma"),
        (HistogramOfShifts(), {"sigma": [-3.0, 10.0]}, "expected a"),
        (HistogramOfShifts(), {"max_bins": [1]}, "no numeric parameter"),
        (HistogramOfShifts(), {"sigma": []}, "at least one value"),
        (HistogramOfShifts(), {"max_distance": [np.nan, 1.0]}, "max_distance: expected numbers"),
        (AnchorPoints(), {"weight": ["unti"]}, "weight='unti': expected one of fs, dmf, ratio, unit"),
        (MatchCount(), {"weight": [UnitWeight()]}, "no numeric parameter 'weight'; expected one of max_distance"),
    ],
)
def test_wrong_axes_raise(matches, scorer, axes, words):
    with pytest.raises(ValueError, match=words):
        score_grid(scorer, matches, **axes)


def test_parameters_of_parts_are_axes_by_dotted_names(matches):
    axes = {"inner.sigma": [10.0, 30.0], "share": [0.0, 1.0, 2.0], "inner.bin_size": [8.0, 15.0]}
    scores = score_grid(Wrapped(), matches, **axes)
    assert scores.shape == (2, 3, 2, 3)
    for row, (sigma, share, bin_size) in zip(scores.reshape(-1, 3), itertools.product(*axes.values()), strict=True):
        scorer = Wrapped(HistogramOfShifts(sigma=sigma, bin_size=bin_size), share)
        np.testing.assert_allclose(row, score_candidates(scorer, matches), rtol=2e-6)


@pytest.mark.parametrize("count", [4, 20])
def test_a_plain_function_may_close_over_traced_values(count):
    """Few candidates at once, or as many as would be shared by the cores."""
    pairs, scaled = random_pairs([30] * count), HistogramOfShifts()
    expected = np.sum(score_grid(scaled, pairs, sigma=[10.0, 20.0]))

    def total(t, **axes):
        weight = lambda matches: t * scaled.weight(matches)  # noqa: E731
        scorer = scaled if axes else replace(scaled, weight=weight)
        return jnp.sum(score_grid(scorer, pairs, sigma=[10.0, 20.0], **{name: [weight] for name in axes}))

    np.testing.assert_allclose(jax.grad(total)(2.0), expected, rtol=1e-5)
    np.testing.assert_allclose(jax.vmap(partial(total, weight=None))(jnp.ones(2)), [expected] * 2, rtol=1e-5)
    sigmas = jnp.array([10.0, 20.0])
    twice = jax.jit(lambda t: t * score_grid(scaled, pairs, sigma=sigmas))(2.0)
    np.testing.assert_allclose(jnp.sum(twice), 2 * expected, rtol=1e-5)
