"""A query's matches with its candidates, which are on the device, on all cores."""

from functools import partial

import jax
import numpy as np

from mfvpr.matchers import Matcher, match_pairs
from mfvpr.numerics import available_cpus, device_bytes, knows_own_context
from mfvpr.threads import ordered_map
from mfvpr.types import Features, Matches


def matched(query: Features, arrays: Features, slots: np.ndarray, number: int, matcher: Matcher) -> Matches:
    """Matches `[C, K, ...]`, NumPy, each pair as if alone.

    A pair's product keeps all cores busy, but what follows it one: so each core has some of the pairs, but on a device
    of its own memory, which takes all at the same time.

    Args:
        query: `[1, N, ...]`.
        arrays: `[S, N, ...]` on the device.
        slots: `[n]` of the candidates.
        number: C; beyond n there are no matches.
        matcher: of one pair.
    """
    calls = available_cpus() if device_bytes(arrays) is None else 1
    size = -(-number // calls)
    pairs = np.zeros((calls * size, 2), np.int32)
    pairs[: len(slots), 1] = slots

    def some(start: int) -> Matches:
        real = np.int32(np.clip(len(slots) - start, 0, size))
        return jax.device_get(match_pairs(query, arrays, pairs[start : start + size], real, matcher))

    spread = partial(ordered_map, workers=calls) if calls > 1 and knows_own_context() else map
    parts = list(spread(some, range(0, calls * size, size)))
    return jax.tree.map(lambda *fields: np.concatenate(fields)[:number], *parts)
