__all__ = [
    "ALONE",
    "PAPER",
    "SCORERS",
    "Estimate",
    "GridAnchors",
    "Homography",
    "LostScore",
    "OpenCvHomography",
    "RapidSpatialScore",
    "VisualPhrases",
]

from .grid_anchors import GridAnchors
from .homography import Estimate, Homography
from .homography_opencv import OpenCvHomography
from .lost import LostScore
from .phrases import VisualPhrases
from .rapid import RapidSpatialScore
from .scorers import ALONE, PAPER, SCORERS
