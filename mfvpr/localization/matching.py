"""Match a query with its candidates on the device, score the matches on all cores, and measure the shift of a pair."""

from collections.abc import Iterable, Mapping
from functools import partial

import jax
import numpy as np
from jaxtyping import Float, Int

from mfvpr.evaluation.stages import pair_shifts
from mfvpr.evaluation.validation import require_finite
from mfvpr.features.feature_set import stack_features
from mfvpr.matching.matcher import Matcher, match_pairs
from mfvpr.reranking.ranking import BIN_STEP, score_candidates
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.parameters import with_capacity
from mfvpr.scoring.scorer import Scorer, require_scores
from mfvpr.types import Features, Matches
from mfvpr.utils.numerics import available_cpus, device_bytes, knows_own_context, round_up
from mfvpr.utils.threads import ordered_map

Point = tuple[float, float]

_AT_ONCE = 25  # pairs; with ten a prediction takes 8 ms longer


def match_and_score(
    query: Features, database: Features, slots: Int[np.ndarray, " n"], number: int, matcher: Matcher,
    scorers: Mapping[str, Scorer],
) -> tuple[Matches, dict[str, Float[np.ndarray, " n"]]]:  # fmt: skip
    """Matches `[C, K, ...]` of an unpadded query, and scores by name; no pair's result depends on the other pairs.

    A pair's product keeps all cores busy, but the steps after it keep one busy. So each core takes a few pairs at a
    time. Their number is the same for any number of cores, since the last bits of scores depend on it. A device with
    memory of its own takes all pairs at once.

    Args:
        database: `[S, N, ...]` on the device.
        slots: of the candidates.
        number: C; beyond n there are no matches. If no score is finite, an InputError is raised.
    """
    padded_query = stack_features([query], database.mask.shape[1], total=1)
    size = min(number, _AT_ONCE) if device_bytes(database) is None else number
    pairs = np.zeros((round_up(number, size), 2), np.int32)
    pairs[: len(slots), 1] = slots

    def match_part(start: int) -> tuple[Matches, dict[str, np.ndarray]]:
        real = np.int32(np.clip(len(slots) - start, 0, size))
        matches = match_pairs(padded_query, database, pairs[start : start + size], real, matcher)
        return jax.device_get((matches, {name: _scores(scorer, matches) for name, scorer in scorers.items()}))

    workers = min(available_cpus(), len(pairs) // size)
    map_parts = partial(ordered_map, workers=workers) if workers > 1 and knows_own_context() else map
    parts = list(map_parts(match_part, range(0, len(pairs), size)))
    matches, scores = jax.tree.map(lambda *fields: np.concatenate(fields)[:number], *parts)
    scores = {name: values[: len(slots)] for name, values in scores.items()}
    for name, values in scores.items():
        require_finite(name, values)
    return matches, scores


def _scores(scorer: Scorer, matches: Matches) -> Float[jax.Array, " pairs"]:
    """Scores of pairs, float32; an InputError if the scorer does not return a real number for each."""
    scores = score_candidates(scorer, matches)
    require_scores(type(scorer).__name__, scores, len(matches.mask))
    return scores.astype(np.float32)


def shift_of(
    scorers: Iterable[Scorer], pair: Matches, size: tuple[int, int]
) -> tuple[Point | None, tuple[Point, Point] | None]:
    """`shift` and `shift_interval` of a `Prediction` by the first histogram of shifts, from one pair.

    Shifts of the resized images become px of the query image, whose size is (width, height).
    """
    scorer = next((scorer for scorer in scorers if isinstance(scorer, HistogramOfShifts)), None)
    if scorer is None:
        return None, None
    histogram = with_capacity(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval = (np.asarray(values)[0] for values in pair_shifts(histogram, pair))
    stretch = np.divide(size, np.asarray(pair.image_size0)[0])
    shift, interval = stretch * shift, stretch * interval
    low, high = _point(interval[0]), _point(interval[1])
    return _point(shift), (low, high) if low and high else None


def _point(values: np.ndarray) -> Point | None:
    return (float(values[0]), float(values[1])) if np.isfinite(values).all() else None
