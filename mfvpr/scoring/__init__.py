"""Scores of one pair of images from its matches alone: values that map Matches to a scalar, one method per file."""

from collections.abc import Callable

from mfvpr.scoring.aggregate import AggregatedScore
from mfvpr.scoring.anchor import AnchorPoints
from mfvpr.scoring.counting import MatchCount
from mfvpr.scoring.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.scoring.lost import LostScore
from mfvpr.scoring.phrases import VisualPhrases
from mfvpr.scoring.rapid import RapidSpatialScore
from mfvpr.scoring.shifts import image_sizes, match_shifts
from mfvpr.types import Array, Matches

Scorer = Callable[[Matches], Array]
"""Maps the Matches of ONE pair, slots `[K]`, to a score `[]` float32: larger = more likely the same place, exactly 0
for a pair without matches, and the same whatever the order of the matches, how much is padding, and what that holds.

Any callable will do. A class decorated with `mfvpr.value` gets more than a plain function: its numbers may be swept,
traced and learned, and its programs are kept. `mfvpr.testing.check_scorer` checks all of this.
"""

SCORERS: dict[str, type] = {
    "count": MatchCount,
    "rapid": RapidSpatialScore,
    "phrases": VisualPhrases,
    "lost": LostScore,
    "sum": AggregatedScore,
    "anchor": AnchorPoints,
    "histogram": HistogramOfShifts,
}
"""The scores that programs know, by name. Their settings follow from their fields (`mfvpr.declaration`)."""

__all__ = [
    "SCORERS",
    "AggregatedScore",
    "AnchorPoints",
    "HistogramOfShifts",
    "LostScore",
    "MatchCount",
    "RapidSpatialScore",
    "Scorer",
    "ShiftHistogram",
    "VisualPhrases",
    "image_sizes",
    "match_shifts",
]
