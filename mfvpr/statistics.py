"""How sure a recall is, and whether two differ: on the same queries, which follow each other along a path."""

from typing import NamedTuple

import numpy as np
from scipy import stats


class McNemar(NamedTuple):
    """Two systems on the same queries.

    only_first, only_second: queries that only one of them gets right.
    p_value: probability of a difference at least this large if neither were better.
    """

    only_first: int
    only_second: int
    p_value: float


def bootstrap_interval(
    hits: np.ndarray, *, level: float = 0.95, block_length: int | None = None, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Confidence interval of the recall of queries along a path: percentiles of a circular block bootstrap.

    Neighboring queries succeed and fail together, so blocks of them are drawn, not single ones (Politis & Romano,
    1992).

    Args:
        hits: `[Q]` bool or in [0, 1], in the order of the path.
        level: of confidence.
        block_length: queries that are drawn together; by default the cube root of Q, rounded.
        resamples: drawn.
        seed: of the draw.

    Returns:
        (low, high), fractions; (0, 0) without queries.
    """
    hits = np.asarray(hits, np.float64)
    total = len(hits)
    if total == 0:
        return 0.0, 0.0
    length = min(block_length or max(1, round(total ** (1 / 3))), total)
    blocks = -(-total // length)
    starts = np.random.default_rng(seed).integers(0, total, (resamples, blocks))
    around = np.concatenate([[0.0], np.cumsum(np.concatenate([hits, hits]))])
    last = total - (blocks - 1) * length  # the last block is cut, so that each resample has Q queries
    lengths = np.full(blocks, length)
    lengths[-1] = last
    means = (around[starts + lengths[None]] - around[starts]).sum(axis=1) / total
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def mcnemar(first: np.ndarray, second: np.ndarray) -> McNemar:
    """Exact test of two systems' hits `[Q]` bool (McNemar, 1947): a fair coin for every query in which they differ.

    It takes queries for independent. Along a path they are not quite, and the p-value is smaller than it should be.
    """
    first, second = np.asarray(first, bool), np.asarray(second, bool)
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    differ = only_first + only_second
    p_value = float(stats.binomtest(only_first, differ).pvalue) if differ else 1.0
    return McNemar(only_first, only_second, p_value)
