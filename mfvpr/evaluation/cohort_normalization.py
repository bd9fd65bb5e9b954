"""Score normalization with a cohort: lower the scores of hubs, database images that score high with any query.

    sequence = cohort_sequence(FeatureCache().recipes.contents(dataset.database), 5)
    cohort = match_sequence(dataset, sequence, system.pipeline)
    scores = score({"histogram": HistogramOfShifts()}, cohort.by_scale, cohort.candidates)["histogram"]
    strengths = hubness(cohort.candidates, scores, len(dataset.database))
    normalized = by_hubness(candidates, query_scores, strengths)

`mfvpr.System(..., cohort=5)` does this for all scorers. The cohort of a database image are other places of the map.
Only the last line needs queries; all others run when the map is made. Images far apart in the drive count as different
places: if the drive passes a place twice, its images score high with each other and are treated as hubs.
"""

import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Shortlist
from mfvpr.datasets.contents import Contents, own_rows
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.evaluation.shortlist_scores import Scores
from mfvpr.utils.errors import InputError

PRIOR = 10  # average scores: on synthetic streets an image's scores vary ten times as much as the images' means


def cohort_sequence(database: Contents, neighbors: int) -> QuerySequence:
    """The database images, in the order of the drive, as queries without candidates of the same place.

    The `neighbors` on both sides of an image show the same place, and images of equal content do, too.
    """
    number = len(database.folder)
    if not isinstance(neighbors, int | np.integer) or isinstance(neighbors, bool) or neighbors < 0:
        raise InputError(f"cohort={neighbors!r}: expected frames on both sides that show the same place, a whole "
                         "number from 0, or None")  # fmt: skip
    if neighbors >= number // 2:
        raise InputError(f"cohort={neighbors}: expected less than half of {number} database images, as an image is "
                         "scored with those that are farther away; leave fewer out")  # fmt: skip
    equal_rows = tuple(tuple({row, *same}) for row, same in enumerate(own_rows(database, database)))
    return QuerySequence("cohort", database.folder, None).without_neighbors(number, equal_rows, int(neighbors))


def hubness(
    candidates: Shortlist, scores: Scores, num_database: int, *, name: str = "a scorer"
) -> Float[np.ndarray, " database"]:
    """Hubness of each database image, float64 above 0, from candidates and scores of the cohort's images.

    The hubness is the mean score of the image with other places, over the mean of all scores. `PRIOR` average scores
    are added to the scores of each image. The hubness is 1 for an image without scores, and if all scores are 0. Scores
    that are not finite are ignored; a score below 0 of the scorer `name` raises an `InputError`.
    """
    known = np.asarray(candidates.mask) & np.isfinite(scores)
    rows, values = np.asarray(candidates.indices)[known], np.asarray(scores, np.float64)[known]
    _require_positive(values, name)
    if not values.any():
        return np.ones(num_database)
    sums = np.bincount(rows, values / values.mean(), num_database)
    return (sums + PRIOR) / (np.bincount(rows, minlength=num_database) + PRIOR)


def by_hubness(
    candidates: Shortlist, scores: Scores, hubness: Float[np.ndarray, " database"], *, name: str = "a scorer"
) -> Scores:
    """Scores divided by the hubness of the candidates, float32.

    A hubness below 1 does not count: an image that hardly matches anything would gain by every match. NaN stays NaN.
    A score below 0, which division would increase, raises an `InputError`.
    """
    _require_positive(scores, name)
    return (scores / np.maximum(hubness, 1)[candidates.indices]).astype(np.float32)


def _require_positive(scores: np.ndarray, scorer: str) -> None:
    if (lowest := np.min(scores, initial=0, where=~np.isnan(scores))) < 0:
        raise InputError(f"cohort: expected scores from 0, which can be divided, got {lowest:.4g} of {scorer}; choose "
                         "another score, features of a single scale, or no cohort")  # fmt: skip
