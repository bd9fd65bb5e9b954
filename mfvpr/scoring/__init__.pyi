__all__ = [
    "ALONE",
    "PAPER",
    "SCORERS",
    "AggregatedScore",
    "AnchorPoints",
    "Estimate",
    "GridAnchors",
    "HistogramOfShifts",
    "Homography",
    "LostScore",
    "MatchCount",
    "OpenCvHomography",
    "RapidSpatialScore",
    "Scorer",
    "ShiftHistogram",
    "VisualPhrases",
    "image_sizes",
    "match_shifts",
]

from .aggregate import AggregatedScore
from .anchor import AnchorPoints
from .counting import MatchCount
from .grid import GridAnchors
from .histogram import HistogramOfShifts, ShiftHistogram
from .homography import Estimate, Homography
from .homography_opencv import OpenCvHomography
from .lost import LostScore
from .phrases import VisualPhrases
from .rapid import RapidSpatialScore
from .registry import ALONE, PAPER, SCORERS
from .scorer import Scorer
from .shifts import image_sizes, match_shifts
