"""A query's matches with its candidates, which are on the device, and their scores, on all cores."""

from functools import partial

import jax
import numpy as np

from mfvpr.matching.matcher import Matcher, match_pairs
from mfvpr.reranking.ranking import score_candidates
from mfvpr.scoring.scorer import Scorer
from mfvpr.types import Features, Matches
from mfvpr.utils.numerics import available_cpus, device_bytes, knows_own_context, round_up
from mfvpr.utils.threads import ordered_map

_AT_ONCE = 25  # pairs; with ten an answer takes 8 ms longer


def scored(
    query: Features, arrays: Features, slots: np.ndarray, number: int, matcher: Matcher, scorer: Scorer
) -> tuple[Matches, np.ndarray]:
    """(matches `[C, K, ...]`, scores `[C]`), NumPy, each pair as if alone.

    A pair's product keeps all cores busy, but what follows it one: so each core takes some of the pairs and then some
    more, as many for any number of cores, since the last bits of scores depend on it; but a device of its own memory
    takes all at the same time.

    Args:
        query: `[1, N, ...]`.
        arrays: `[S, N, ...]` on the device.
        slots: `[n]` of the candidates.
        number: C; beyond n there are no matches.
        matcher: of one pair.
        scorer: of one pair's matches.
    """
    size = min(number, _AT_ONCE) if device_bytes(arrays) is None else number
    pairs = np.zeros((round_up(number, size), 2), np.int32)
    pairs[: len(slots), 1] = slots

    def some(start: int) -> tuple[Matches, np.ndarray]:
        real = np.int32(np.clip(len(slots) - start, 0, size))
        matches = match_pairs(query, arrays, pairs[start : start + size], real, matcher)
        return jax.device_get((matches, score_candidates(scorer, matches)))

    workers = min(available_cpus(), len(pairs) // size)
    spread = partial(ordered_map, workers=workers) if workers > 1 and knows_own_context() else map
    parts = list(spread(some, range(0, len(pairs), size)))
    return jax.tree.map(lambda *fields: np.concatenate(fields)[:number], *parts)
