"""Confidence intervals of recalls, and tests of their differences, on queries that follow each other along a path."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy import special, stats

from mfvpr.utils.errors import InputError

_PSEUDO_EVENTS = 1.0  # with a default autocorrelation: a path with hits only, or misses only, does not show its own


class McNemar(NamedTuple):
    """Two systems on the same queries."""

    only_first: int  # queries for which only this system is correct
    only_second: int
    p_value: float  # probability of a difference at least this large if neither were better


class SignFlips(NamedTuple):
    """Two systems on the same queries, by blocks of the path, see `block_sign_flips`."""

    block: int  # number of queries of a block
    blocks: int  # number of blocks in which one of the two is ahead
    p_value: float  # probability of a difference at least this large if the sign of each of these blocks were random


class Estimate(NamedTuple):
    """A recall, fraction of the queries, and its confidence interval, see `recall_interval`."""

    recall: float
    interval: tuple[float, float]


def estimate(hits: Bool[np.ndarray, " queries"]) -> Estimate:
    """Recall of hits along a path with at least one query, with its confidence interval."""
    return Estimate(float(np.mean(hits)), recall_interval(hits))


def recall_interval(hits: np.ndarray, *, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the recall of queries along a path, which succeed and fail together with their neighbors.

    The interval of Clopper and Pearson (1934) for the effective number of independent queries, Q / `design_effect`,
    which is reduced because it is an estimate (Korn & Graham, Survey Methodology 24, 1998). It never has zero width:
    100 hits of 100 give [82.8 %, 100 %].

    In simulations with recalls of 0.5 to 1 and 50 to 500 queries, the 95 % interval covers the recall in at least 96 %
    without autocorrelation, and in at least 89 % with 0.8 from query to query; with 0.9 in at least 88 % from 300
    queries, but down to 77 % for 50 or 101 queries, which are worth 3 to 6 independent ones.

    Args:
        hits: `[Q]` bool, in the order of the path.
        level: of confidence.

    Returns:
        (low, high), fractions; (0, 1) without queries.
    """
    hits = np.asarray(hits, bool)
    if hits.ndim != 1:
        raise InputError(f"hits: expected [Q], one of every query, got {list(hits.shape)}; call it for each row")
    if len(hits) == 0:
        return 0.0, 1.0
    effective = len(hits) / design_effect(hits)
    effective *= (_quantile(level, len(hits)) / _quantile(level, effective)) ** 2
    correct = hits.mean() * effective
    incorrect, tail = effective - correct, (1 - level) / 2
    low = special.betaincinv(correct, incorrect + 1, tail) if correct > 0 else 0.0
    high = special.betaincinv(correct + 1, incorrect, 1 - tail) if incorrect > 0 else 1.0
    return float(low), float(high)


def design_effect(hits: np.ndarray) -> float:
    """Number of queries of a path, in 1 ... Q, that are worth one independent query, from hits `[Q]` bool.

    This is the variance of the mean divided by the variance for independent queries. It is the larger of two estimates:
    a flat-top lag window whose width follows from the data (Politis & White, Econometric Reviews 23, 2004, section
    3.2), and a Markov chain with the lag-1 autocorrelation, corrected for its bias (Kendall, Biometrika 41, 1954),
    since short paths hide slow changes. A path of only hits or only misses shows no autocorrelation; then the result is
    the cube root of Q. With few hits or few misses, this default counts as much as one of them.
    """
    hits = np.asarray(hits, np.float64)
    return _design_effect([hits], min(hits.sum(), len(hits) - hits.sum()))


def mcnemar(first: np.ndarray, second: np.ndarray) -> McNemar:
    """Exact test of two systems' hits `[Q]` bool (McNemar, 1947): a fair coin for every query in which they differ.

    The test assumes independent queries. Along a path they are not, and the p-value is too small; see
    `block_sign_flips`.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    differ = only_first + only_second
    p_value = float(stats.binomtest(only_first, differ).pvalue) if differ else 1.0
    return McNemar(only_first, only_second, p_value)


def block_sign_flips(
    first: np.ndarray, second: np.ndarray, *, block: int | None = None, sequences: Sequence[int] | None = None,
    places: np.ndarray | None = None,
) -> SignFlips:  # fmt: skip
    """Exact test of two systems' hits along a path: a fair coin for every block of neighbors, which differ together.

    The statistic is the difference of the two recalls. All flips of the blocks' signs are counted, by convolution. With
    blocks of one query this is `mcnemar`.

    False positives in simulations of equally good systems with recalls of 0.5 to 0.95, more or less similar
    (thresholded Gaussian sequences of 101 to 500 queries): p is at most 5 % in at most 6 % of the simulations without
    autocorrelation, in at most 7 % with 0.5 between latent neighbors, and in at most 8 % with 0.8 or 0.9 (`mcnemar`: in
    up to 6, 18, 44 and 61 %). p is at most 1 % in at most 3 %.

    Args:
        first: `[Q]` bool, in the order of the path.
        second: `[Q]` bool, of the same queries.
        block: queries of a block, from 1; the last of a sequence may be shorter. None = the cube root of Q times the
            `design_effect` of the differences. If they change slowly along the path, few blocks remain, and no
            difference is significant.
        sequences: number of queries of each sequence, if there are several one after the other; no block contains
            queries of two sequences.
        places: `[Q]` whole numbers in the order of the path, if several queries show the same places, for example on
            several drives. Then blocks are made of places. Without `places`, p is below 5 % in up to 58 % of the
            simulations of equally good systems on several drives.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    sequences = [len(first)] if sequences is None else [*sequences]
    if first.ndim != 1 or first.shape != second.shape or sum(sequences) != len(first) or min(sequences, default=0) < 0:
        raise InputError(f"hits: expected two [Q] of the same queries, and sequences of as many, got "
                         f"{list(first.shape)}, {list(second.shape)} and sequences of {sequences}")  # fmt: skip
    if block is not None and block < 1:
        raise InputError(f"block={block}: expected a number of queries from 1")
    paths = np.split(first.astype(int) - second.astype(int), np.cumsum(sequences)[:-1])
    if places is not None:
        _, rows = np.unique(places, return_inverse=True)
        paths = [np.bincount(rows, weights=np.concatenate(paths)).astype(int)]
    block = _block_length(paths) if block is None else block
    ahead = [path[start : start + block].sum() for path in paths for start in range(0, len(path), block)]
    ahead = np.abs(ahead)[np.flatnonzero(ahead)]
    return SignFlips(block, len(ahead), _flipped_tail(ahead, abs(sum(path.sum() for path in paths))))


def _block_length(paths: Sequence[np.ndarray]) -> int:
    """The default block length; at the rate of the cube root, the correlation of neighboring blocks is negligible."""
    differences, total = float(sum(map(np.count_nonzero, paths))), sum(map(len, paths))
    return max(1, min(math.ceil(total ** (1 / 3) * _design_effect(paths, differences)), total))


def _flipped_tail(sizes: np.ndarray, total: int) -> float:
    """Probability that whole numbers `[B]` with random signs have a sum of absolute value at least `total`."""
    reach = int(sizes.sum())
    chances = np.zeros(2 * reach + 1)  # of the sums -reach ... reach
    chances[reach] = 1
    for size in map(int, sizes):
        chances = (np.roll(chances, size) + np.roll(chances, -size)) / 2  # the ends are still empty
    return min(1.0, float(chances[np.abs(np.arange(-reach, reach + 1)) >= total].sum()))


def _design_effect(paths: Sequence[np.ndarray], events: float) -> float:
    """`design_effect` of the values of several paths; `events` counts the informative ones (hits, or differences)."""
    total = sum(map(len, paths))
    default = total ** (1 / 3)
    if events == 0 or np.ptp(np.concatenate(paths)) == 0:
        return default
    correlations = _autocorrelations(paths)
    estimate = max(1.0, _flat_top(correlations), _markov(correlations))
    return min((events * estimate + _PSEUDO_EVENTS * default) / (events + _PSEUDO_EVENTS), float(total))


def _quantile(level: float, count: float) -> float:
    """Two-sided quantile of Student's t for the mean of `count` values."""
    return float(stats.t.ppf((1 + level) / 2, max(count - 1, 1)))


def _autocorrelations(paths: Sequence[np.ndarray]) -> np.ndarray:
    """Autocorrelations `[Q]` at lags 0 ... Q - 1 within paths of Q values in total, which are not all equal."""
    mean, total = np.concatenate(paths).mean(), sum(map(len, paths))
    spectra = [np.fft.rfft(path - mean, 2 * total) for path in paths]  # padded: a path is no circle
    covariances = np.fft.irfft(sum(np.abs(spectrum) ** 2 for spectrum in spectra))[:total]
    return covariances / covariances[0]


def _flat_top(correlations: np.ndarray) -> float:
    """Sum of the autocorrelations at all lags in a window that is 1 up to half its width and falls to 0 at its end."""
    total = len(correlations)
    run = max(5, math.ceil(math.sqrt(math.log10(total))))
    insignificant = np.abs(correlations[1:]) < 2 * math.sqrt(math.log10(total) / total)
    half = 0  # the lag after which the next few autocorrelations are all insignificant
    while half < math.sqrt(total) and not insignificant[half : half + run].all():
        half += 1
    lags = np.arange(1, total)
    window = np.clip(2 - lags / max(half, 1), 0, 1)
    return 1 + 2 * float(window @ correlations[1:])


def _markov(correlations: np.ndarray) -> float:
    """Sum of the autocorrelations at all lags if they fall like powers of the first."""
    total = len(correlations)
    if total <= 3:
        return 1.0
    first = np.clip((total * correlations[1] + 1) / (total - 3), 0, 0.98)
    return float((1 + first) / (1 - first))
