"""Scores of one pair of images from its matches alone: values that map Matches to a scalar, one method per file."""

from collections.abc import Callable

from mfvpr.scoring.aggregate import AggregatedScore
from mfvpr.scoring.anchor import AnchorPoints
from mfvpr.scoring.counting import MatchCount
from mfvpr.scoring.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.types import Array, Matches

Scorer = Callable[[Matches], Array]

__all__ = ["AggregatedScore", "AnchorPoints", "HistogramOfShifts", "MatchCount", "Scorer", "ShiftHistogram"]
