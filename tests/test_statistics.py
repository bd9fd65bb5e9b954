"""Intervals and tests against closed forms and explicit loops."""

import math

import numpy as np
import pytest

from mfvpr.statistics import bootstrap_interval, mcnemar


def test_interval_is_the_quantiles_of_resampled_blocks():
    """The same draws, block by block in a loop."""
    rng = np.random.default_rng(3)
    hits = rng.random(23) < 0.6
    length, resamples, seed = 4, 300, 7
    starts = np.random.default_rng(seed).integers(0, 23, (resamples, 6))
    means = []
    for row in starts:
        drawn = [hits[(start + step) % 23] for start in row for step in range(length)][:23]
        means.append(np.mean(drawn))
    expected = np.quantile(means, [0.05, 0.95])
    got = bootstrap_interval(hits, level=0.9, block_length=length, resamples=resamples, seed=seed)
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_single_draws_give_the_binomial_interval():
    hits = np.arange(400) % 4 == 0
    low, high = bootstrap_interval(hits, block_length=1)
    half = 1.96 * math.sqrt(0.25 * 0.75 / 400)
    assert abs(low - (0.25 - half)) < 0.006
    assert abs(high - (0.25 + half)) < 0.006


def test_runs_of_hits_widen_the_interval():
    """Neighbors that succeed together are worth fewer queries."""
    runs = np.repeat(np.random.default_rng(0).random(40) < 0.5, 10)
    alone = np.diff(bootstrap_interval(runs, block_length=1))
    together = np.diff(bootstrap_interval(runs, block_length=20))
    assert together > 2 * alone


@pytest.mark.parametrize("hits", [np.ones(9), np.zeros(9), np.ones(1)])
def test_certain_recalls_have_no_width(hits):
    assert bootstrap_interval(hits) == (hits[0], hits[0])


def test_no_queries_give_an_empty_interval():
    assert bootstrap_interval(np.zeros(0)) == (0.0, 0.0)


@pytest.mark.parametrize(("only_first", "only_second"), [(0, 0), (1, 0), (3, 3), (9, 2), (2, 9), (0, 12)])
def test_mcnemar_is_a_fair_coin_on_the_queries_that_differ(only_first, only_second):
    first = np.array([1] * only_first + [0] * only_second + [1] * 5 + [0] * 4, bool)
    second = np.array([0] * only_first + [1] * only_second + [1] * 5 + [0] * 4, bool)
    tosses = only_first + only_second
    tail = sum(math.comb(tosses, k) for k in range(min(only_first, only_second) + 1)) / 2**tosses
    got = mcnemar(first, second)
    assert got[:2] == (only_first, only_second)
    assert got.p_value == pytest.approx(min(1.0, 2 * tail))
