# ruff: noqa: I001, RUF022
# Public names in the order of the stages. Each is imported when it is first used.

# values that pass from stage to stage
from .types import Features, Matches, Ranking, Shortlist

# shortlists from global descriptors
from .retrieval.search import retrieve

# matches of two images, and of a query with its candidates
from .matching.host import HostMatcher
from .matching.lightglue import LightGlueMatcher
from .matching.matcher import Matcher, NearestNeighborMatcher, match_pairs
from .matching.nearest_neighbors import compact, filter_matches, match, match_candidates
from .matching.soft import soft_match

# weights of matches
from .scoring.weights import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    RatioWeight,
    UnitWeight,
    Weight,
    match_weights,
)

# scores of one pair
from .scoring.aggregate import AggregatedScore
from .scoring.anchor import AnchorPoints
from .scoring.counting import MatchCount
from .scoring.grid import GridAnchors
from .scoring.histogram import HistogramOfShifts, ShiftHistogram
from .scoring.homography import Homography
from .scoring.homography_opencv import OpenCvHomography
from .scoring.lost import LostScore
from .scoring.phrases import VisualPhrases
from .scoring.rapid import RapidSpatialScore

# scores of all candidates, whole grids of parameters, fusion and ranking
from .reranking.grids import score_grid
from .reranking.ranking import balancing_c, combine, rank, rerank, score_candidates

# data sets, what is correct, and recall
from . import datasets
from .datasets.positives import frame_positives, radius_positives
from .evaluation.metrics import recall_at_k

# systems, by name or by parts; a whole data set, and one image at a time
from .cli.systems import load_system
from .cli.sweeps import sweep
from .evaluation.system import Pipeline, System
from .utils.cluster import Cluster
from .utils.runtime import Runtime
from .report.results import Result, evaluate
from .localization.map import Map
from .localization.route import Drive, Route

# programs without Python
from .deployment.folders import export, load_exported
from .deployment.programs import ExportShapes

# tools for a scorer of your own; see mfvpr.testing.check_scorer
from .scoring.scorer import Scorer
from .types import value
from .scoring.shifts import image_sizes, match_shifts
from .utils.numerics import masked, masked_mean, masked_median, safe_sqrt

# mistakes of a caller, in one line
from .utils.errors import InputError

__version__: str
__all__ = [
    "Features",
    "Matches",
    "Ranking",
    "Shortlist",
    "retrieve",
    "HostMatcher",
    "LightGlueMatcher",
    "Matcher",
    "NearestNeighborMatcher",
    "match_pairs",
    "compact",
    "filter_matches",
    "match",
    "match_candidates",
    "soft_match",
    "DescriptorDistanceWeight",
    "FeatureScoreWeight",
    "RatioWeight",
    "UnitWeight",
    "Weight",
    "match_weights",
    "AggregatedScore",
    "AnchorPoints",
    "MatchCount",
    "GridAnchors",
    "HistogramOfShifts",
    "ShiftHistogram",
    "Homography",
    "OpenCvHomography",
    "LostScore",
    "VisualPhrases",
    "RapidSpatialScore",
    "score_grid",
    "balancing_c",
    "combine",
    "rank",
    "rerank",
    "score_candidates",
    "datasets",
    "frame_positives",
    "radius_positives",
    "recall_at_k",
    "load_system",
    "sweep",
    "Pipeline",
    "System",
    "Cluster",
    "Runtime",
    "Result",
    "evaluate",
    "Map",
    "Drive",
    "Route",
    "export",
    "load_exported",
    "ExportShapes",
    "Scorer",
    "value",
    "image_sizes",
    "match_shifts",
    "masked",
    "masked_mean",
    "masked_median",
    "safe_sqrt",
    "InputError",
]
