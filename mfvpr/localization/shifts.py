"""The shift between a query and a candidate, for steering, if the scorer is a histogram of shifts."""

import numpy as np

from mfvpr.evaluation.stages import pair_shifts
from mfvpr.reranking.ranking import BIN_STEP
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.parameters import with_capacity
from mfvpr.scoring.scorer import Scorer
from mfvpr.types import Matches

Point = tuple[float, float]


def shift_of(scorer: Scorer, pair: Matches) -> tuple[Point | None, tuple[Point, Point] | None, float | None]:
    """`shift`, `shift_interval` and `scale` of an `Answer`, from the matches `[1, K, ...]` of a pair."""
    if not isinstance(scorer, HistogramOfShifts):
        return None, None, None
    scorer = with_capacity(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval, scale = (np.asarray(values)[0] for values in pair_shifts(scorer, pair))
    low, high = _point(interval[0]), _point(interval[1])
    return _point(shift), (low, high) if low and high else None, float(scale) if np.isfinite(scale) else None


def _point(values: np.ndarray) -> Point | None:
    return (float(values[0]), float(values[1])) if np.isfinite(values).all() else None
