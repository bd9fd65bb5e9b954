"""Scorers by name."""

from mfvpr.scoring.aggregate import AggregatedScore
from mfvpr.scoring.anchor import AnchorPoints
from mfvpr.scoring.counting import MatchCount
from mfvpr.scoring.grid import GridAnchors
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.homography import Homography
from mfvpr.scoring.homography_opencv import OpenCvHomography
from mfvpr.scoring.lost import LostScore
from mfvpr.scoring.phrases import VisualPhrases
from mfvpr.scoring.rapid import RapidSpatialScore

SCORERS: dict[str, type] = {
    "count": MatchCount,
    "rapid": RapidSpatialScore,
    "phrases": VisualPhrases,
    "lost": LostScore,
    "sum": AggregatedScore,
    "anchor": AnchorPoints,
    "histogram": HistogramOfShifts,
    "grid": GridAnchors,
    "homography": Homography,
    "homography_opencv": OpenCvHomography,
}
"""Scorers of the programs by name. Their settings follow from their fields (`mfvpr.scoring.parameters`)."""

PAPER = ("count", "sum", "anchor", "histogram")
"""Scorers that are compared by default."""

ALONE = ("homography_opencv", "grid")
"""Scorers that `scorer=all` leaves out: OpenCV takes a second per query, and not all features are cells of a grid."""
