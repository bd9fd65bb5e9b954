"""Confidence intervals of recalls, and tests of their differences, on queries that follow each other along a path."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import special

from mfvpr.utils.errors import InputError


class McNemar(NamedTuple):
    """Two systems on the same queries."""

    only_first: int  # queries for which only this system is correct
    only_second: int
    p_value: float  # probability of a difference at least this large if neither were better


class PathTest(NamedTuple):
    """Two systems on the same queries along a path, see `path_test`."""

    design_effect: float  # so many neighboring queries count as one; 1 = independent
    p_value: float  # as McNemar's, for the effective number of queries


class Estimate(NamedTuple):
    """A recall, fraction of the queries, and its confidence interval, see `recall_interval`."""

    recall: float
    interval: tuple[float, float]


def estimate(hits: Bool[np.ndarray, " queries"]) -> Estimate:
    """Recall of hits along a path with at least one query, with its confidence interval."""
    return Estimate(float(np.mean(hits)), recall_interval(hits))


def recall_interval(hits: np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of the recall of hits `[Q]` bool along a path, where neighbors fail together.

    The interval of Clopper and Pearson (1934) for Q / `design_effect` independent queries; (0, 1) without queries. In
    simulations with recalls of 0.5 to 0.95 and autocorrelations of the hits up to 0.9, it covers the recall in at least
    90 %, and in less if noise of single queries hides a slow change.
    """
    hits = np.asarray(hits, bool)
    if hits.ndim != 1:
        raise InputError(f"hits: expected [Q], one of every query, got {list(hits.shape)}; call it for each row")
    if len(hits) == 0:
        return 0.0, 1.0
    effective = len(hits) / design_effect(hits)
    correct = hits.mean() * effective
    incorrect = effective - correct
    low = special.betaincinv(correct, incorrect + 1, 0.025) if correct > 0 else 0.0
    high = special.betaincinv(correct + 1, incorrect, 0.975) if incorrect > 0 else 1.0
    return float(low), float(high)


def design_effect(hits: np.ndarray) -> float:
    """So many neighboring queries of a path count as one, in 1 ... Q (1 = independent), from hits `[Q]` bool.

    This is the variance of the mean divided by the variance for independent queries, estimated from the
    autocorrelation. Few hits or misses show little autocorrelation, so that the result is
    (w estimate + 10 Q^(1/3)) / (w + 1) with w = (n / estimate)^3 / 6 for n hits or misses, the rarer. These numbers
    were chosen by simulation.
    """
    hits = np.asarray(hits, np.float64)
    estimate = _variance_ratio(hits)
    weight = (min(hits.sum(), len(hits) - hits.sum()) / estimate) ** 3 / 6
    return min((weight * estimate + 10 * len(hits) ** (1 / 3)) / (weight + 1), float(len(hits)))


def mcnemar(first: np.ndarray, second: np.ndarray) -> McNemar:
    """Exact test of two systems' hits `[Q]` bool (McNemar, 1947): a fair coin for every query in which they differ.

    The test assumes independent queries. Along a path they are not, and the p-value is too small; see `path_test`.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    return McNemar(only_first, only_second, _coin_p_value(only_first, only_second))


def path_test(first: np.ndarray, second: np.ndarray) -> PathTest:
    """Test of two systems' hits `[Q]` bool along a path: `mcnemar` for the effective number of independent queries.

    That is by the largest `design_effect` of both systems' hits and of their differences, in which noise of one system
    hides slow changes of the other. In simulations of equally good systems with autocorrelations of the hits up to 0.9,
    p is at most 5 % in at most 5 % (`mcnemar`: in up to 89 %), and in more if noise of single queries hides a slow
    change. Sort the queries of several drives by their places.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    if first.ndim != 1 or first.shape != second.shape:
        raise InputError(f"hits: expected two [Q] of the same queries, got {list(first.shape)}, {list(second.shape)}")
    effect = max(design_effect(first), design_effect(second), _variance_ratio(first - second.astype(float)))
    return PathTest(effect, _coin_p_value(np.sum(first & ~second) / effect, np.sum(second & ~first) / effect))


def _coin_p_value(heads: float, tails: float) -> float:
    """Two-sided binomial p-value of a fair coin; the counts need not be whole numbers."""
    more, fewer = max(heads, tails), min(heads, tails)
    return min(1.0, 2 * float(special.betainc(more, fewer + 1, 0.5))) if more > fewer else 1.0


def _variance_ratio(values: np.ndarray) -> float:
    """The design effect of values `[Q]`, in 1 ... Q, as in a Markov chain.

    The larger of two estimates: from the autocorrelation of neighboring queries, and of neighboring blocks of sqrt(Q)
    queries, since noise of single queries hides slow changes.
    """
    total, ratio = len(values), 1.0
    if total <= 3:
        return ratio
    values = values - values.mean()
    for block in {1, round(math.sqrt(total))}:
        count = total // block
        sums = values[: count * block].reshape(count, block).sum(axis=1)
        sums -= sums.mean()
        variance = sums @ sums
        if count > 3 and variance > 0:
            correlation = (count * (sums[1:] @ sums[:-1]) / variance + 1) / (count - 3)  # Kendall, Biometrika 41, 1954
            correlation = min(max(correlation, 0.0), 0.98)
            of_one = variance / (count * block) / np.mean(values**2)
            ratio = max(ratio, float(of_one * (1 + correlation) / (1 - correlation)))
    return min(ratio, float(total))
