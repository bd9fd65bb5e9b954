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
from .homography import Estimate, Homography, OpenCvHomography
from .scorers import ALONE, PAPER, SCORERS
from .spatial_scores import LostScore, RapidSpatialScore, VisualPhrases
