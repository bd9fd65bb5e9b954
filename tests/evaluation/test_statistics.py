"""Intervals and tests against closed forms, explicit loops and simulated paths."""

import math

import numpy as np
import pytest
from scipy import signal, stats

from mfvpr.evaluation import mcnemar
from mfvpr.evaluation.statistics import design_effect, path_test, recall_interval
from mfvpr.utils import InputError


def latent_paths(recall, correlation, queries, count=200, systems=1, shared=0.0, seed=0):
    """Hits `[systems, count, queries]` where Gaussian sequences, which share a part, stay below a threshold."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((systems + 1, count, queries))
    noise[..., 1:] *= math.sqrt(1 - correlation**2)
    common, *separate = signal.lfilter([1], [1, -correlation], noise)
    return math.sqrt(shared) * common + math.sqrt(1 - shared) * np.array(separate) < stats.norm.ppf(recall)


def averaged_paths(recall, window, queries, count=200, seed=0):
    """Hits of single queries, whose latent path has noise, and hits after averages in a window: [2, count, queries]."""
    rng = np.random.default_rng(seed)
    shape = count, queries + len(window) - 1
    latent = math.sqrt(0.3) * signal.lfilter([math.sqrt(0.75)], [1, -0.5], rng.standard_normal(shape))
    latent += math.sqrt(0.7) * rng.standard_normal(shape)
    average = signal.fftconvolve(latent, window[None], mode="valid", axes=1)
    return np.array([path / path.std() < stats.norm.ppf(recall) for path in (latent[:, :queries], average)])


def ratio_oracle(values):
    """The larger variance ratio of a Markov chain of queries and of blocks of queries, with loops."""
    total, mean, ratios = len(values), sum(values) / len(values), [1.0]
    variance = sum((value - mean) ** 2 for value in values) / total
    for size in (1, round(math.sqrt(total))):
        count = total // size
        sums = [sum(value - mean for value in values[start * size : (start + 1) * size]) for start in range(count)]
        center = sum(sums) / count
        squares = sum((value - center) ** 2 for value in sums)
        products = sum((sums[place] - center) * (sums[place + 1] - center) for place in range(count - 1))
        first = min(max((count * products / squares + 1) / (count - 3), 0), 0.98)
        ratios.append(squares / (count * size) / variance * (1 + first) / (1 - first))
    return min(max(ratios), total)


def effect_oracle(hits):
    """The design effect of hits that are not all equal."""
    ratio, rarer = ratio_oracle(hits), min(sum(hits), len(hits) - sum(hits))
    weight = (rarer / ratio) ** 3 / 6
    return min((weight * ratio + 10 * len(hits) ** (1 / 3)) / (weight + 1), len(hits))


@pytest.mark.parametrize("correlation", [0, 0.6, 0.9])
def test_design_effect_equals_the_loops(correlation):
    for hits in latent_paths(0.7, correlation, 80, count=10, seed=1)[0]:
        assert design_effect(hits) == pytest.approx(effect_oracle(hits.astype(int).tolist()), rel=1e-9)


def test_interval_is_the_binomial_one_of_as_many_queries_as_the_path_is_worth():
    for hits in latent_paths(0.8, 0.5, 60, count=10, seed=2)[0]:
        worth = 60 / design_effect(hits)
        correct, (low, high) = hits.mean() * worth, recall_interval(hits)
        assert stats.beta(correct, worth - correct + 1).cdf(low) == pytest.approx(0.025)
        tail = stats.beta(worth - correct, correct + 1).cdf(1 - high)
        assert tail == pytest.approx(0.025, rel=1e-3)  # 1 - high is small


# Autocorrelations of the latent path for which the hits have 0.9 from query to query.
@pytest.mark.parametrize(("recall", "latent"), [(0.5, 0.988), (0.65, 0.988), (0.8, 0.99), (0.95, 0.993)])
@pytest.mark.parametrize("queries", [101, 300])
def test_along_a_path_the_recall_is_in_nine_of_ten_intervals(recall, latent, queries):
    """Two standard errors are allowed for."""
    paths = latent_paths(recall, latent, queries, count=300)[0]
    low, high = np.array([recall_interval(hits) for hits in paths]).T
    assert np.mean((low <= recall) & (recall <= high)) >= 0.9 - 2 * math.sqrt(0.9 * 0.1 / 300)


def test_all_right_is_not_certain_and_misses_mirror_hits():
    for queries in (1, 2, 9, 100):
        low, high = recall_interval(np.ones(queries))
        assert 0 < low < 0.025 ** (1 / queries) + 1e-12  # Clopper and Pearson's with independent queries
        assert high == 1
    rng = np.random.default_rng(4)
    for queries in (1, 2, 3, 4, 5, 10, 33):
        for share in rng.random(20):
            hits = rng.random(queries) < share
            low, high = recall_interval(hits)
            assert 0 <= low <= hits.mean() <= high <= 1
            assert low < high
            np.testing.assert_allclose(recall_interval(~hits), (1 - high, 1 - low), atol=1e-9)


def test_hits_are_of_one_system_or_of_two_on_the_same_queries():
    assert recall_interval(np.zeros(0)) == (0.0, 1.0)
    with pytest.raises(InputError, match=r"hits: expected \[Q\].* got \[2, 5\]"):
        recall_interval(np.ones((2, 5), bool))
    with pytest.raises(InputError, match=r"got \[5\], \[4\]"):
        path_test(np.ones(5), np.ones(4))


@pytest.mark.parametrize(("only_first", "only_second"), [(0, 0), (1, 0), (3, 3), (9, 2), (2, 9), (0, 12)])
def test_mcnemar_is_a_fair_coin_on_the_queries_that_differ(only_first, only_second):
    first = np.array([1] * only_first + [0] * only_second + [1] * 5 + [0] * 4, bool)
    second = np.array([0] * only_first + [1] * only_second + [1] * 5 + [0] * 4, bool)
    got, tosses = mcnemar(first, second), only_first + only_second
    assert got[:2] == (only_first, only_second)
    assert got.p_value == pytest.approx(stats.binomtest(only_first, tosses).pvalue if tosses else 1)


def test_path_test_is_a_fair_coin_on_as_many_queries_as_the_path_is_worth():
    for first, second in latent_paths(0.6, 0.5, 101, count=20, systems=2).swapaxes(0, 1):
        paths = [values.tolist() for values in (first.astype(int), second.astype(int), first.astype(int) - second)]
        effect = max(effect_oracle(paths[0]), effect_oracle(paths[1]), ratio_oracle(paths[2]))
        more, fewer = sorted([(first > second).sum() / effect, (first < second).sum() / effect], reverse=True)
        tail = stats.beta(more, fewer + 1).cdf(0.5)  # P(at most `fewer` of `more + fewer` tosses)
        assert path_test(first, second) == path_test(second, first)
        assert path_test(first, second) == pytest.approx((effect, 1.0 if more == fewer else min(1.0, 2 * tail)))


@pytest.mark.parametrize("queries", [101, 300, 1000])
@pytest.mark.parametrize("recall", [0.5, 0.8])
def test_a_sequence_seldom_differs_from_equally_good_single_queries(queries, recall):
    """At 5 %; two standard errors are allowed for. Windows are causal and smoothed averages."""
    causal, smoothed = 0.9 ** np.arange(60), np.convolve(np.ones(12), np.ones(12))
    pairs = [averaged_paths(recall, window, queries, count=100) for window in (causal, smoothed)]
    single = latent_paths(recall, 0, queries, count=100, seed=1)
    pairs += [np.concatenate([single, latent_paths(recall, latent, queries, count=100)]) for latent in (0.95, 0.99)]
    for pair in pairs:
        assert np.mean([path_test(*hits).p_value <= 0.05 for hits in pair.swapaxes(0, 1)]) <= 0.05 + 0.044


def test_equal_systems_often_differ_by_mcnemar_along_a_path_and_a_better_one_is_found():
    pairs = latent_paths(0.8, 0.8, 300, systems=2, shared=0.3).swapaxes(0, 1)
    assert np.mean([mcnemar(*pair).p_value <= 0.05 for pair in pairs]) > 0.25
    assert np.mean([path_test(*pair).p_value <= 0.05 for pair in pairs]) <= 0.07
    worse, better = latent_paths(0.8, 0, 300, seed=1)[0], latent_paths(0.9, 0, 300, seed=2)[0]
    assert np.mean([path_test(*pair).p_value <= 0.05 for pair in zip(worse, better, strict=True)]) > 0.6
