"""The shift between a query and a candidate, for steering, if the scorer is a histogram of shifts."""

from typing import NamedTuple

import numpy as np

from mfvpr.evaluation.stages import pair_shifts
from mfvpr.reranking.ranking import BIN_STEP
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.parameters import with_capacity
from mfvpr.scoring.scorer import Scorer
from mfvpr.types import Matches

Point = tuple[float, float]


class Shift(NamedTuple):
    """The fields of the same names of `mfvpr.localization.Answer`."""

    shift: Point | None = None
    interval: tuple[Point, Point] | None = None
    scale: float | None = None


def shift_of(scorer: Scorer, pair: Matches) -> Shift:
    """The shift of one pair, from its matches `[1, K, ...]`."""
    if not isinstance(scorer, HistogramOfShifts):
        return Shift()
    fitted = with_capacity(scorer, pair.image_size0, pair.image_size1, multiple=BIN_STEP)
    shift, interval, scale = (np.asarray(values)[0] for values in pair_shifts(fitted, pair))
    low, high = _point(interval[0]), _point(interval[1])
    return Shift(_point(shift), (low, high) if low and high else None, float(scale) if np.isfinite(scale) else None)


def _point(values: np.ndarray) -> Point | None:
    return (float(values[0]), float(values[1])) if np.isfinite(values).all() else None
