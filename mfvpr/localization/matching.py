"""Match a query with its candidates on the device, score the matches on all cores, and measure the shift of a pair."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.batch import BIN_STEP, score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.scorer import Scorer, fit_capacities, require_scores
from mfvpr.core.types import Features, Matches
from mfvpr.evaluation.stages import pair_shifts, require_finite
from mfvpr.features.feature_set import STEP, stack_features
from mfvpr.matchers.matcher import Matcher, match_pairs
from mfvpr.utils.numerics import available_cpus, knows_own_context, round_up
from mfvpr.utils.threads import ordered_map

Point = tuple[float, float]

_AT_ONCE = 8  # pairs: a scorer takes the time of so many, also for a single image of a rare size
_LEAST = 256  # slots of an image


def match_and_score(
    query: Features, candidates: Sequence[Features], matcher: Matcher, scorers: Mapping[str, Scorer], typical: int
) -> tuple[list[Matches], dict[str, Float[np.ndarray, " candidates"]]]:
    """Matches `[1, K, ...]` of an unpadded query with each candidate, and scores by name.

    Images are padded to one of a few sizes by their own numbers of keypoints, so that no pair's result and time depend
    on the other pairs. A pair's product keeps all cores busy, but the steps after it keep one busy. So each core takes
    a few pairs at a time. `typical` is a usual number of keypoints, or the detector's limit. If no score is finite, an
    InputError is raised.
    """
    padded_query = stack_features([query], padded_size(len(query.mask), typical), total=1)
    by_size = defaultdict[int, list[int]](list)
    for place, candidate in enumerate(candidates):
        by_size[padded_size(len(candidate.mask), typical)].append(place)
    parts = [
        (size, places[start : start + _AT_ONCE])
        for size, places in sorted(by_size.items(), reverse=True)
        for start in range(0, len(places), _AT_ONCE)
    ]

    def match_part(part: tuple[int, list[int]]) -> tuple[Matches, dict[str, np.ndarray]]:
        size, places = part
        images = stack_features([candidates[place] for place in places], size, total=_AT_ONCE)
        pairs = np.stack([np.zeros(_AT_ONCE, np.int32), np.arange(_AT_ONCE, dtype=np.int32)], axis=1)
        matches = match_pairs(padded_query, images, pairs, np.int32(len(places)), matcher)
        return jax.device_get((matches, {name: _scores(scorer, matches) for name, scorer in scorers.items()}))

    workers = min(available_cpus(), len(parts))
    map_parts = partial(ordered_map, workers=workers) if workers > 1 and knows_own_context() else map
    matches, scores = {}, {name: np.zeros(len(candidates), np.float32) for name in scorers}
    for (_, places), (of_part, scores_of_part) in zip(parts, map_parts(match_part, parts), strict=True):
        for number, place in enumerate(places):
            matches[place] = jax.tree.map(lambda leaf: leaf[number : number + 1], of_part)  # noqa: B023
        for name, values in scores_of_part.items():
            scores[name][places] = values[: len(places)]
    for name, values in scores.items():
        require_finite(name, values)
    return [matches[place] for place in range(len(candidates))], scores


def padded_size(count: int, typical: int) -> int:
    """Slots for an image: `typical` rounded up, or a power of 2 from 256 on: few sizes, so few programs."""
    size, typical = 1 << (max(count, _LEAST) - 1).bit_length(), round_up(typical, STEP)
    return min(size, typical) if typical >= count else size


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
    histogram = fit_capacities(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval = (np.asarray(values)[0] for values in pair_shifts(histogram, pair))
    stretch = np.divide(size, np.asarray(pair.image_size0)[0])
    shift, interval = stretch * shift, stretch * interval
    low, high = _point(interval[0]), _point(interval[1])
    return _point(shift), (low, high) if low and high else None


def _point(values: np.ndarray) -> Point | None:
    return (float(values[0]), float(values[1])) if np.isfinite(values).all() else None
