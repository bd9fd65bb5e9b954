"""Intervals and tests against closed forms, explicit loops and simulated paths."""

import math

import numpy as np
import pytest
from scipy import stats

from mfvpr.errors import InputError
from mfvpr.evaluation.statistics import design_effect, mcnemar, recall_interval


def paths(recall, correlation, queries, count=200, seed=0):
    """Hits `[count, queries]` of Markov chains with a recall and a correlation between neighbors."""
    rng = np.random.default_rng(seed)
    hits = np.empty((count, queries), bool)
    hits[:, 0] = rng.random(count) < recall
    for query in range(1, queries):
        stay = correlation + (1 - correlation) * np.where(hits[:, query - 1], recall, 1 - recall)
        hits[:, query] = (rng.random(count) < stay) == hits[:, query - 1]
    return hits


def effect_oracle(hits):
    """The design effect, with loops over lags and queries."""
    total, mean = len(hits), sum(hits) / len(hits)
    covariances = [
        sum((hits[query] - mean) * (hits[query + lag] - mean) for query in range(total - lag)) for lag in range(total)
    ]
    correlations = [covariance / covariances[0] for covariance in covariances]
    bound = 2 * math.sqrt(math.log10(total) / total)
    half = 0
    while any(abs(value) >= bound for value in correlations[half + 1 : half + 6]) and half < math.sqrt(total):
        half += 1
    half = max(half, 1)
    flat = 1 + 2 * sum(value * min(1, max(0, 2 - lag / half)) for lag, value in enumerate(correlations) if lag)
    first = min(max((total * correlations[1] + 1) / (total - 3), 0), 0.98)
    rarer = min(sum(hits), total - sum(hits))
    return (rarer * max(1, flat, (1 + first) / (1 - first)) + total ** (1 / 3)) / (rarer + 1)


@pytest.mark.parametrize("correlation", [0, 0.6, 0.9])
def test_design_effect_equals_the_loops(correlation):
    for hits in paths(0.7, correlation, 80, count=10, seed=1):
        if hits.all() or not hits.any():
            continue
        assert design_effect(hits) == pytest.approx(min(effect_oracle(hits.tolist()), 80), rel=1e-9)


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_interval_is_the_binomial_one_of_as_many_queries_as_the_path_is_worth(level):
    for hits in paths(0.8, 0.5, 60, count=10, seed=2):
        worth = 60 / design_effect(hits)
        worth *= (stats.t(59).ppf((1 + level) / 2) / stats.t(worth - 1).ppf((1 + level) / 2)) ** 2
        right, tail = hits.mean() * worth, (1 - level) / 2
        low, high = recall_interval(hits, level=level)
        assert stats.beta(right, worth - right + 1).cdf(low) == pytest.approx(tail)
        assert stats.beta(right + 1, worth - right).sf(high) == pytest.approx(tail)


@pytest.mark.parametrize("recall", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("queries", [50, 100])
def test_along_a_path_the_recall_is_in_nine_of_ten_intervals(recall, queries):
    """At an autocorrelation of 0.8; blocks of the cube root of Q gave 34 to 78 of 100."""
    low, high = np.array([recall_interval(hits) for hits in paths(recall, 0.8, queries)]).T
    assert np.mean((low <= recall) & (recall <= high)) >= 0.9


def test_independent_queries_have_nearly_the_binomial_interval():
    for hits in paths(0.8, 0, 400, count=20):
        low, high = recall_interval(hits)
        expected = stats.binomtest(int(hits.sum()), 400).proportion_ci()
        assert expected.high - expected.low <= high - low
    widths = [np.diff(recall_interval(hits)) for hits in paths(0.8, 0, 400)]
    assert np.mean(widths) < 1.15 * 2 * 1.96 * math.sqrt(0.8 * 0.2 / 400)


def test_runs_of_hits_widen_the_interval():
    """Neighbors that succeed together are worth fewer queries."""
    runs = np.repeat(np.random.default_rng(0).random(40) < 0.5, 10)
    mixed = np.random.default_rng(0).permutation(runs)
    assert 5 < design_effect(runs) < 30
    assert design_effect(mixed) < 1.5
    assert np.diff(recall_interval(runs)) > 2 * np.diff(recall_interval(mixed))


@pytest.mark.parametrize("queries", [1, 2, 9, 100])
def test_all_right_is_not_certain(queries):
    low, high = recall_interval(np.ones(queries))
    assert 0 < low < 1
    assert high == 1
    assert low < 0.025 ** (1 / queries) + 1e-12  # Clopper and Pearson's with independent queries
    np.testing.assert_allclose(recall_interval(np.zeros(queries)), (0, 1 - low), atol=1e-12)


def test_the_recall_is_inside_and_misses_mirror_hits():
    rng = np.random.default_rng(4)
    for queries in (1, 2, 3, 4, 5, 10, 33):
        for _ in range(20):
            hits = rng.random(queries) < rng.random()
            low, high = recall_interval(hits)
            assert 0 <= low <= hits.mean() <= high <= 1
            assert low < high
            np.testing.assert_allclose(recall_interval(~hits), (1 - high, 1 - low), atol=1e-9)


def test_no_queries_tell_nothing():
    assert recall_interval(np.zeros(0)) == (0.0, 1.0)


def test_hits_of_several_systems_are_told():
    with pytest.raises(InputError, match=r"hits: expected \[Q\], one of every query, got \[2, 5\]"):
        recall_interval(np.ones((2, 5), bool))


@pytest.mark.parametrize(("only_first", "only_second"), [(0, 0), (1, 0), (3, 3), (9, 2), (2, 9), (0, 12)])
def test_mcnemar_is_a_fair_coin_on_the_queries_that_differ(only_first, only_second):
    first = np.array([1] * only_first + [0] * only_second + [1] * 5 + [0] * 4, bool)
    second = np.array([0] * only_first + [1] * only_second + [1] * 5 + [0] * 4, bool)
    tosses = only_first + only_second
    tail = sum(math.comb(tosses, k) for k in range(min(only_first, only_second) + 1)) / 2**tosses
    got = mcnemar(first, second)
    assert got[:2] == (only_first, only_second)
    assert got.p_value == pytest.approx(min(1.0, 2 * tail))
