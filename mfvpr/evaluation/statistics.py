"""How sure a recall is, and whether two differ: on the same queries, which follow each other along a path."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from mfvpr.utils.errors import InputError

_PSEUDO_EVENTS = 1.0  # of a default autocorrelation: a path with hits only, or misses only, does not show its own


class McNemar(NamedTuple):
    """Two systems on the same queries.

    only_first, only_second: queries that only one of them gets right.
    p_value: probability of a difference at least this large if neither were better.
    """

    only_first: int
    only_second: int
    p_value: float


class SignFlips(NamedTuple):
    """Two systems on the same queries, by blocks of the path, see `block_sign_flips`.

    block: queries of a block.
    blocks: those in which one of the two is ahead.
    p_value: probability of a difference at least this large if each of these blocks were as likely the other way round.
    """

    block: int
    blocks: int
    p_value: float


class Estimate(NamedTuple):
    """A recall and how sure it is.

    recall: fraction of the queries.
    interval: its confidence interval, see `recall_interval`.
    """

    recall: float
    interval: tuple[float, float]


def estimate(hits: np.ndarray) -> Estimate:
    """Recall of queries along a path, `[Q]` bool, at least one, with its interval."""
    return Estimate(float(np.mean(hits)), recall_interval(hits))


def recall_interval(hits: np.ndarray, *, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the recall of queries along a path, which succeed and fail together with their neighbors.

    Clopper and Pearson's (1934) at the number of independent queries that the path is worth, Q / `design_effect`, less
    what is due to that number being an estimate (Korn & Graham, Survey Methodology 24, 1998). It never has zero width:
    100 hits of 100 say [82.8 %, 100 %].

    Drawn Markov chains of 50 to 500 queries had their recall (0.5 to 1) in 96 % or more of these intervals without
    autocorrelation, in 92 % or more with 0.8 from query to query; with 0.9 in 91 % or more from 300 queries, but down
    to 77 % at 50 or 101, which are worth no more than 3 to 6 independent ones. Thresholded Gaussian sequences, which
    forget more slowly than their first lag says: with 0.8 between latent neighbors in 91 to 98 % at 101 queries, in 89
    % or more at 50; with 0.9 in 79 % or more at 50, 85 % or more at 101, 88 % or more at 300.

    Args:
        hits: `[Q]` bool, in the order of the path.
        level: of confidence.

    Returns:
        (low, high), fractions; (0, 1) without queries.

    Raises:
        InputError: hits of another rank.
    """
    hits = np.asarray(hits, bool)
    if hits.ndim != 1:
        raise InputError(f"hits: expected [Q], one of every query, got {list(hits.shape)}; call it for each row")
    if len(hits) == 0:
        return 0.0, 1.0
    worth = len(hits) / design_effect(hits)
    worth *= (_quantile(level, len(hits)) / _quantile(level, worth)) ** 2
    right = hits.mean() * worth
    wrong, tail = worth - right, (1 - level) / 2
    low = special.betaincinv(right, wrong + 1, tail) if right > 0 else 0.0
    high = special.betaincinv(right + 1, wrong, 1 - tail) if wrong > 0 else 1.0
    return float(low), float(high)


def design_effect(hits: np.ndarray) -> float:
    """How many queries of a path `[Q]` bool are worth one independent query, in 1 ... Q.

    The larger of two estimates of the variance of the mean, in units of that of independent queries: a flat-top lag
    window whose width follows from the data (Politis & White, Econometric Reviews 23, 2004, section 3.2), and a Markov
    chain with the lag-1 autocorrelation, corrected for its bias (Kendall, Biometrika 41, 1954), since short paths hide
    slow changes. A path that is all hits or all misses tells nothing; then it is the cube root of Q, which with few
    hits or few misses counts as much as one of these.
    """
    hits = np.asarray(hits, np.float64)
    return _design_effect([hits], min(hits.sum(), len(hits) - hits.sum()))


def mcnemar(first: np.ndarray, second: np.ndarray) -> McNemar:
    """Exact test of two systems' hits `[Q]` bool (McNemar, 1947): a fair coin for every query in which they differ.

    It takes queries for independent. Along a path they are not, and the p-value is smaller than it should be: with an
    autocorrelation of 0.8 between neighbors of latent Gaussian sequences it is at most 5 % in 7 to 44 % of the draws of
    two systems that are equally good. See `block_sign_flips`.
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

    Drawn thresholded Gaussian sequences of 101 to 500 queries, two systems equally good, more or less alike, with
    recalls of 0.5 to 0.95: p is at most 5 % in at most 6 % of the draws without autocorrelation, in at most 7 % with
    0.5 between latent neighbors, in at most 8 % with 0.8 or 0.9 (McNemar's in up to 6, 18, 44 and 61 %); it is at most
    1 % in at most 3 %.

    Args:
        first: `[Q]` bool, in the order of the path.
        second: of the same queries.
        block: queries of a block, from 1; the last of a sequence may be shorter. None = the cube root of Q times the
            `design_effect` of the differences; where they change slowly along the path, that leaves few blocks, which
            no difference makes significant.
        sequences: how many of the queries each sequence has, one behind the other, where there are several: no block
            goes from one into the next.
        places: `[Q]` whole numbers in the order of the path, where several queries, such as those of several drives
            along it, show the same places: then blocks are of places, whose queries differ together. Drives taken for
            independent have p below 5 % in up to 58 % of the draws of equally good systems.

    Raises:
        InputError: hits of other shapes, sequences of other queries, or blocks without any.
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
    """By the cube root, the rate at which what neighboring blocks share gets lost in the error of its estimate."""
    differ, total = float(sum(map(np.count_nonzero, paths))), sum(map(len, paths))
    return max(1, min(math.ceil(total ** (1 / 3) * _design_effect(paths, differ)), total))


def _flipped_tail(sizes: np.ndarray, total: int) -> float:
    """The probability that whole numbers `[B]` with random signs sum to at least a total, either way."""
    reach = int(sizes.sum())
    chances = np.zeros(2 * reach + 1)  # of the sums -reach ... reach
    chances[reach] = 1
    for size in map(int, sizes):
        chances = (np.roll(chances, size) + np.roll(chances, -size)) / 2  # the ends are still empty
    return min(1.0, float(chances[np.abs(np.arange(-reach, reach + 1)) >= total].sum()))


def _design_effect(paths: Sequence[np.ndarray], events: float) -> float:
    """Of all values of some paths, of which so many tell something."""
    total = sum(map(len, paths))
    unknown = total ** (1 / 3)
    if events == 0 or np.ptp(np.concatenate(paths)) == 0:
        return unknown
    correlations = _autocorrelations(paths)
    found = max(1.0, _flat_top(correlations), _markov(correlations))
    return min((events * found + _PSEUDO_EVENTS * unknown) / (events + _PSEUDO_EVENTS), float(total))


def _quantile(level: float, count: float) -> float:
    """Of Student's t for the mean of so many values."""
    return float(stats.t.ppf((1 + level) / 2, max(count - 1, 1)))


def _autocorrelations(paths: Sequence[np.ndarray]) -> np.ndarray:
    """`[Q]` at lags 0 ... Q - 1, within paths of Q values together, which differ."""
    mean, total = np.concatenate(paths).mean(), sum(map(len, paths))
    spectra = [np.fft.rfft(path - mean, 2 * total) for path in paths]  # padded: a path is no circle
    covariances = np.fft.irfft(sum(np.abs(spectrum) ** 2 for spectrum in spectra))[:total]
    return covariances / covariances[0]


def _flat_top(correlations: np.ndarray) -> float:
    """Sum of the autocorrelations at all lags, by a window that is 1 up to half its width and falls to 0 at its end.

    Half its width is the lag after which the next few autocorrelations are all insignificant.
    """
    total = len(correlations)
    run = max(5, math.ceil(math.sqrt(math.log10(total))))
    insignificant = np.abs(correlations[1:]) < 2 * math.sqrt(math.log10(total) / total)
    half = 0
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
