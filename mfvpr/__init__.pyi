# ruff: noqa: I001, RUF022
# Public names in the order of the stages. Each is imported when it is first used.

# values that pass from stage to stage
from .core.types import Features, Matches, Ranking, Shortlist

# shortlists from global descriptors
from .retrieval.search import retrieve

# matches of two images, and of a query with its candidates
from .matchers.host_matcher import HostMatcher
from .matchers.matcher import LightGlueMatcher, Matcher, NearestNeighborMatcher, match_pairs, soft_match
from .core.matching import compact, filter_matches, match, match_candidates

# weights of matches
from .core.weights import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    RatioWeight,
    UnitWeight,
    Weight,
    match_weights,
)

# scores of one pair
from .core.aggregate import AggregatedScore, MatchCount
from .core.anchor import AnchorPoints
from .baselines.grid_anchors import GridAnchors
from .core.histogram import HistogramOfShifts, ShiftHistogram
from .baselines.homography import Homography
from .baselines.homography import OpenCvHomography
from .baselines.spatial_scores import LostScore
from .baselines.spatial_scores import VisualPhrases
from .baselines.spatial_scores import RapidSpatialScore

# scores of all candidates, whole grids of parameters, fusion and ranking
from .core.batch import score_candidates, score_grid
from .core.ranking import combine, rank, rerank
from .evaluation.rankings import balancing_c

# data sets, what is correct, and recall
from . import datasets
from .datasets.positives import frame_positives, radius_positives
from .core.metrics import recall_at_k

# systems, by name or by parts; a whole data set, and one image at a time
from .cli.command_line import load_system
from .cli.sweeping import sweep
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
from .core.scorer import Scorer
from .core.types import value
from .core.weights import image_sizes, match_shifts
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
