"""Scores of one pair of images from its matches alone: Matches -> a number.

Read first: scorer (the contract), aggregate (the shortest score), histogram, anchor, then the others; weights (of
matches), fields (units, bounds and choices of settings), registry (scores by name). Parts of scores: shifts, lattice
and tallest (histogram), planes and quads (homography), parameters (by dotted name).

Imports types, utils.
"""

from mfvpr.scoring.aggregate import AggregatedScore
from mfvpr.scoring.anchor import AnchorPoints
from mfvpr.scoring.counting import MatchCount
from mfvpr.scoring.grid import GridAnchors
from mfvpr.scoring.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.scoring.homography import Estimate, Homography
from mfvpr.scoring.homography_opencv import OpenCvHomography
from mfvpr.scoring.lost import LostScore
from mfvpr.scoring.phrases import VisualPhrases
from mfvpr.scoring.rapid import RapidSpatialScore
from mfvpr.scoring.registry import ALONE, PAPER, SCORERS
from mfvpr.scoring.scorer import Scorer
from mfvpr.scoring.shifts import image_sizes, match_shifts

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
