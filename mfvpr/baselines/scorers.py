"""Scorers by name."""

from mfvpr.baselines.grid_anchors import GridAnchors
from mfvpr.baselines.homography import Homography, OpenCvHomography
from mfvpr.baselines.spatial_scores import LostScore, RapidSpatialScore, VisualPhrases
from mfvpr.core.aggregate import AggregatedScore, MatchCount
from mfvpr.core.anchor import AnchorPoints
from mfvpr.core.histogram import HistogramOfShifts

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
"""Scorers of the programs by name. Their settings follow from their fields (`mfvpr.core.scorer`)."""

PAPER = ("count", "sum", "anchor", "histogram")
"""Scorers that are compared by default."""

ALONE = ("homography_opencv", "grid")
"""Scorers that `scorer=all` leaves out: OpenCV takes a second per query, and not all features are cells of a grid."""
