"""Hubs: database images that score high with whatever query, known by their scores with other places of the map.

    matched = match_cohort(dataset, 5, extractor, filter)
    among = pipeline.score({"histogram": HistogramOfShifts()}, matched.by_scale, matched.candidates)
    better = by_hubness(candidates, scores, hubness(matched.candidates, among["histogram"], len(dataset.database)))

All but the last is done when the map is made: no query takes part. Images far apart in the drive count as other places:
where it passes a place twice, its images score high with each other, and lose as hubs do.
"""

import numpy as np

from mfvpr.datasets.contents import Contents
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.datasets.sequences import own_rows, without_neighbors
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError

# Usual scores that each image is thought to have beside its own. On drawn streets the scores of an image vary (in
# variance) about ten times as much as the means of images do.
PRIOR = 10


def cohort_sequence(database: Contents, neighbors: int) -> QuerySequence:
    """The database images as queries, none of which finds its own place.

    Args:
        database: M images in the order of the drive.
        neighbors: frames on both sides of an image that show its place, as images of the same content do.

    Raises:
        InputError: no whole number from 0, or so many that an image has no others left.
    """
    number = len(database.folder)
    if not isinstance(neighbors, int | np.integer) or isinstance(neighbors, bool) or neighbors < 0:
        raise InputError(f"cohort={neighbors!r}: expected frames on both sides that show the same place, a whole "
                         "number from 0, or None")  # fmt: skip
    if neighbors >= number // 2:
        raise InputError(f"cohort={neighbors}: expected less than half of {number} database images, as an image is "
                         "scored with those that are farther away; leave fewer out")  # fmt: skip
    own = tuple(tuple({row, *same}) for row, same in enumerate(own_rows(database, database)))
    return without_neighbors(QuerySequence("cohort", database.folder, None), number, own, int(neighbors))


def hubness(candidates: Shortlist, scores: np.ndarray, num_database: int, *, who: str = "a scorer") -> np.ndarray:
    """`[N]` float64, how high each database image scores with other places, by how high all of them do: above 0.

    The mean of its scores by the mean of all, as if it had `PRIOR` further ones that are usual: 1 where it has none, or
    where all are 0.

    Args:
        candidates: `[M, C]` of the cohort's images.
        scores: `[M, C]` of these; those that are not finite take no part.
        num_database: N.
        who: scores them.

    Raises:
        InputError: scores below 0.
    """
    known = np.asarray(candidates.mask) & np.isfinite(scores)
    rows, values = np.asarray(candidates.indices)[known], np.asarray(scores, np.float64)[known]
    _require_positive(values, who)
    if not values.any():
        return np.ones(num_database)
    sums = np.bincount(rows, values / values.mean(), num_database)
    return (sums + PRIOR) / (np.bincount(rows, minlength=num_database) + PRIOR)


def by_hubness(candidates: Shortlist, scores: np.ndarray, hubness: np.ndarray, *, who: str = "a scorer") -> np.ndarray:
    """Scores `[Q, C]` of a sequence's candidates, those of hubs divided by their `hubness` `[N]`; NumPy float32.

    Only those above 1 count: an image that hardly matches anything would gain by every match. NaN stays NaN.

    Raises:
        InputError: scores below 0, which would grow.
    """
    _require_positive(scores, who)
    return (scores / np.maximum(hubness, 1)[candidates.indices]).astype(np.float32)


def _require_positive(scores: np.ndarray, who: str) -> None:
    if (lowest := np.min(scores, initial=0, where=~np.isnan(scores))) < 0:
        raise InputError(f"cohort: expected scores from 0, which can be divided, got {lowest:.4g} of {who}; choose "
                         "another score, features of a single scale, or no cohort")  # fmt: skip
