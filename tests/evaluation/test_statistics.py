"""Intervals and tests against closed forms, explicit loops and simulated paths."""

import itertools
import math

import numpy as np
import pytest
from scipy import signal, stats

from mfvpr.evaluation import mcnemar
from mfvpr.evaluation.statistics import block_sign_flips, design_effect, recall_interval
from mfvpr.utils import InputError


def latent_paths(recall, correlation, queries, count=200, systems=1, shared=0.0, seed=0):
    """Hits `[systems, count, queries]` where Gaussian sequences, which share a part, stay below a threshold."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((systems + 1, count, queries))
    noise[..., 1:] *= math.sqrt(1 - correlation**2)
    common, *separate = signal.lfilter([1], [1, -correlation], noise)
    return math.sqrt(shared) * common + math.sqrt(1 - shared) * np.array(separate) < stats.norm.ppf(recall)


def effect_oracle(values, events, sequences=None):
    """The design effect, with loops over lags and queries, of which so many tell something."""
    total, mean = len(values), sum(values) / len(values)
    ends = np.cumsum(sequences or [total])
    owner = np.searchsorted(ends, np.arange(total), side="right")
    covariances = [
        sum((values[query] - mean) * (values[query + lag] - mean) for query in range(total - lag)
            if owner[query] == owner[query + lag])
        for lag in range(total)
    ]  # fmt: skip
    correlations = [covariance / covariances[0] for covariance in covariances]
    bound = 2 * math.sqrt(math.log10(total) / total)
    half = 0
    while any(abs(value) >= bound for value in correlations[half + 1 : half + 6]) and half < math.sqrt(total):
        half += 1
    half = max(half, 1)
    flat = 1 + 2 * sum(value * min(1, max(0, 2 - lag / half)) for lag, value in enumerate(correlations) if lag)
    first = min(max((total * correlations[1] + 1) / (total - 3), 0), 0.98)
    return min((events * max(1, flat, (1 + first) / (1 - first)) + total ** (1 / 3)) / (events + 1), total)


@pytest.mark.parametrize("correlation", [0, 0.6, 0.9])
def test_design_effect_equals_the_loops(correlation):
    for hits in latent_paths(0.7, correlation, 80, count=10, seed=1)[0]:
        if hits.all() or not hits.any():
            continue
        rarer = min(hits.sum(), 80 - hits.sum())
        assert design_effect(hits) == pytest.approx(effect_oracle(hits.tolist(), rarer), rel=1e-9)


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_interval_is_the_binomial_one_of_as_many_queries_as_the_path_is_worth(level):
    for hits in latent_paths(0.8, 0.5, 60, count=10, seed=2)[0]:
        worth = 60 / design_effect(hits)
        worth *= (stats.t(59).ppf((1 + level) / 2) / stats.t(worth - 1).ppf((1 + level) / 2)) ** 2
        correct, tail = hits.mean() * worth, (1 - level) / 2
        low, high = recall_interval(hits, level=level)
        assert stats.beta(correct, worth - correct + 1).cdf(low) == pytest.approx(tail)
        assert stats.beta(correct + 1, worth - correct).sf(high) == pytest.approx(tail)


@pytest.mark.parametrize("recall", [0.5, 0.65, 0.8, 0.95])
def test_along_a_path_the_recall_is_in_nine_of_ten_intervals(recall):
    """Thresholded Gaussian sequences of 101 queries; two standard errors are allowed for."""
    low, high = np.array([recall_interval(hits) for hits in latent_paths(recall, 0.8, 101, count=400)[0]]).T
    assert np.mean((low <= recall) & (recall <= high)) >= 0.9 - 2 * math.sqrt(0.9 * 0.1 / 400)


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


def test_an_interval_needs_one_system_and_no_query():
    assert recall_interval(np.zeros(0)) == (0.0, 1.0)
    with pytest.raises(InputError, match=r"hits: expected \[Q\].* got \[2, 5\]"):
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


def flips_oracle(differences, sequences, block):
    """Number of blocks in which one is ahead, and the share of all their flips that sum to as much, either way."""
    sums, start = [], 0
    for length in sequences:
        path = differences[start : start + length]
        start += length
        sums += [sum(path[place : place + block]) for place in range(0, length, block)]
    sums = [value for value in sums if value]
    flips = [
        abs(sum(sign * value for sign, value in zip(signs, sums, strict=True))) >= abs(sum(sums))
        for signs in itertools.product((1, -1), repeat=len(sums))
    ]
    return len(sums), sum(flips) / len(flips)


@pytest.mark.parametrize("sequences", [[30], [13, 17], [1, 20, 0, 9]])
@pytest.mark.parametrize("block", [1, 3, 4, 50])
def test_block_sign_flips_count_all_flips_of_blocks_within_a_sequence(sequences, block):
    for first, second in latent_paths(0.7, 0.6, 30, count=8, systems=2).swapaxes(0, 1):
        expected = flips_oracle((first.astype(int) - second).tolist(), sequences, block)
        got = block_sign_flips(first, second, block=block, sequences=sequences)
        assert got == (block, expected[0], pytest.approx(expected[1], rel=1e-12))
        assert block_sign_flips(second, first, block=block, sequences=sequences) == got


@pytest.mark.parametrize("sequences", [[101], [60, 41]])
def test_blocks_are_longer_where_neighbors_differ_together(sequences):
    lengths = {}
    for correlation in (0, 0.8):
        pairs = latent_paths(0.7, correlation, 101, count=10, systems=2, shared=0.3).swapaxes(0, 1)
        lengths[correlation] = [block_sign_flips(*pair, sequences=sequences).block for pair in pairs]
        for (first, second), length in zip(pairs, lengths[correlation], strict=True):
            differences = first.astype(int) - second
            effect = effect_oracle(differences.tolist(), np.count_nonzero(differences), sequences)
            assert length == min(math.ceil(101 ** (1 / 3) * effect), 101)
    assert np.median(lengths[0]) < 8
    assert np.median(lengths[0.8]) > 12


@pytest.mark.parametrize("recall", [0.5, 0.8])
def test_equal_systems_seldom_differ_by_blocks_and_often_by_mcnemar(recall):
    """At 5 %; at most 8 % are promised."""
    pairs = latent_paths(recall, 0.8, 101, count=300, systems=2, shared=0.3).swapaxes(0, 1)
    flips, coins = ([test(*pair).p_value <= 0.05 for pair in pairs] for test in (block_sign_flips, mcnemar))
    assert np.mean(flips) <= 0.08
    assert np.mean(coins) > 0.25


def test_systems_that_agree_do_not_differ_and_one_always_ahead_does():
    hits = np.arange(20) < 15
    assert block_sign_flips(hits, hits) == (8, 0, 1.0)  # the cube root, squared
    assert block_sign_flips(hits[:0], hits[:0]) == (1, 0, 1.0)
    ahead = np.ones(40, bool)
    assert block_sign_flips(ahead, ~ahead, block=4) == (4, 10, pytest.approx(2 / 2**10))
    assert block_sign_flips(ahead, ~ahead).block == 12


@pytest.mark.parametrize("options", [{"sequences": [3, 3]}, {"sequences": [6, -1]}, {"block": 0}])
def test_blocks_of_other_queries_are_refused(options):
    with pytest.raises(InputError, match="expected"):
        block_sign_flips(np.ones(5), np.ones(5), **options)
    with pytest.raises(InputError, match=r"got \[5\], \[4\]"):
        block_sign_flips(np.ones(5), np.ones(4))


@pytest.mark.parametrize("block", [2, 5])
def test_queries_of_one_place_differ_together(block):
    """Against all flips of blocks of the sums by place, in whatever order queries are given."""
    rng = np.random.default_rng(0)
    for first, second in latent_paths(0.7, 0.6, 40, count=8, systems=2).swapaxes(0, 1):
        places = rng.integers(-1, 25, 40)
        sums = [int((first.astype(int) - second)[places == place].sum()) for place in np.unique(places)]
        expected = flips_oracle(sums, [len(sums)], block)
        assert block_sign_flips(first, second, block=block, places=places) == (
            block, expected[0], pytest.approx(expected[1], rel=1e-12),
        )  # fmt: skip
