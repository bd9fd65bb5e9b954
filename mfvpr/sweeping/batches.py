"""Matches of all pairs of some queries -> batches of pairs with about as many matches: little padding, few shapes."""

from collections.abc import Iterator

import numpy as np

from mfvpr.numerics import round_up
from mfvpr.pipeline import MatchSet
from mfvpr.types import Matches, per_match

BATCH_SLOTS = 2**14  # matches of a batch of pairs: its votes stay in cache
PAIRS_STEP = 8
SLOTS_STEP = 32
QUANTILES = (0.25, 0.5, 0.75, 0.95, 1.0)
BYTES_PER_SLOT = 33


def slots(match_set: MatchSet) -> np.ndarray:
    """`[Q, C]` slots of the batch that each pair belongs to: few sizes, each a shape to compile, of little padding.

    The sizes are quantiles over all pairs that have matches, so that neither a pair's company nor the part of the
    queries that is worked on changes its score.
    """
    some = match_set.counts[match_set.counts > 0]
    if not some.size:
        return np.full(match_set.counts.shape, SLOTS_STEP)
    sizes = np.ceil(np.quantile(some, QUANTILES) / SLOTS_STEP).astype(int) * SLOTS_STEP
    return sizes[np.searchsorted(sizes, match_set.counts)]


def shapes(match_set: MatchSet) -> dict[int, int]:
    """Pairs of a batch by their slots; not by how many there are, so that a larger set scores them as a smaller one."""
    return {size: round_up(BATCH_SLOTS // size, PAIRS_STEP) for size in np.unique(slots(match_set)).tolist()}


def batches(match_set: MatchSet, queries: range) -> Iterator[tuple[np.ndarray, Matches]]:
    """All pairs that have matches.

    Returns:
        (places `[n]` in the flattened `[queries, C]`, Matches `[P, K, ...]` of P >= n pairs; padding has no matches).
    """
    counts = match_set.counts[queries.start : queries.stop].reshape(-1)
    starts = np.cumsum(counts) - counts
    flat, sizes0, sizes1 = _flattened(match_set, queries)
    sizes = slots(match_set)[queries.start : queries.stop].reshape(-1)
    for size, pairs in shapes(match_set).items():
        places = np.flatnonzero((sizes == size) & (counts > 0))
        for start in range(0, len(places), pairs):
            part = places[start : start + pairs]
            mask = np.zeros((pairs, size), bool)
            mask[: len(part)] = np.arange(size)[None] < counts[part][:, None]
            source = (starts[part][:, None] + np.arange(size)[None])[mask[: len(part)]]
            fields = {name: np.zeros((*mask.shape, *values.shape[1:]), values.dtype) for name, values in flat.items()}
            for name, values in flat.items():
                fields[name][mask] = values[source]
            padded = np.concatenate([part, np.repeat(part[-1:], pairs - len(part))])  # padding has image sizes as well
            yield part, Matches(**fields, mask=mask, image_size0=sizes0[padded], image_size1=sizes1[padded])


def _flattened(match_set: MatchSet, queries: range) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """All matches of some queries one after the other, by field, and both image sizes of every pair."""
    found = [match_set.matches[query] for query in queries]
    parts = [per_match(one) for one in found]
    flat = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    shape = (match_set.counts.shape[1], 2)
    sizes0 = np.concatenate([np.broadcast_to(one.image_size0, shape) for one in found])
    return flat, sizes0, np.concatenate([np.broadcast_to(one.image_size1, shape) for one in found])
