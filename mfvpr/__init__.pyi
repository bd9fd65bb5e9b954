# Public names in the order of the stages; they are imported when they are first used.

# values that pass from stage to stage
# what is correct, and recall
# systems by name; a whole data set, and one image at a time
from .cli.systems import load_system
from .datasets.positives import frame_positives, radius_positives
from .evaluation.evaluation import evaluate
from .evaluation.recall import recall_at_k
from .evaluation.system import Pipeline, System
from .localization.map import Map

# matches of two images, and of a query with its candidates
from .matching.lightglue import LightGlueMatcher
from .matching.matcher import Matcher, NearestNeighborMatcher, match_pairs
from .matching.nearest_neighbors import compact, filter_matches, match, match_candidates
from .matching.soft import soft_match

# scores of all candidates, whole grids of parameters, fusion and ranking
from .reranking.grids import score_grid
from .reranking.ranking import balancing_c, combine, rank, rerank, score_candidates

# shortlists from global descriptors
from .retrieval.search import retrieve

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

# tools for a scorer of your own; see mfvpr.testing.check_scorer
from .scoring.scorer import Scorer
from .scoring.shifts import image_sizes, match_shifts

# weights of matches
from .scoring.weights import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    RatioWeight,
    UnitWeight,
    Weight,
    match_weights,
)
from .types import Features, Matches, Ranking, Shortlist, value

# mistakes of a caller, in one line
from .utils.errors import InputError
from .utils.numerics import masked, masked_mean, masked_median, safe_sqrt
from .utils.runtime import Runtime

__version__: str
__all__ = [
    "AggregatedScore",
    "AnchorPoints",
    "DescriptorDistanceWeight",
    "FeatureScoreWeight",
    "Features",
    "GridAnchors",
    "HistogramOfShifts",
    "Homography",
    "InputError",
    "LightGlueMatcher",
    "LostScore",
    "Map",
    "MatchCount",
    "Matcher",
    "Matches",
    "NearestNeighborMatcher",
    "OpenCvHomography",
    "Pipeline",
    "Ranking",
    "RapidSpatialScore",
    "RatioWeight",
    "Runtime",
    "Scorer",
    "ShiftHistogram",
    "Shortlist",
    "System",
    "UnitWeight",
    "VisualPhrases",
    "Weight",
    "balancing_c",
    "combine",
    "compact",
    "evaluate",
    "filter_matches",
    "frame_positives",
    "image_sizes",
    "load_system",
    "masked",
    "masked_mean",
    "masked_median",
    "match",
    "match_candidates",
    "match_pairs",
    "match_shifts",
    "match_weights",
    "radius_positives",
    "rank",
    "recall_at_k",
    "rerank",
    "retrieve",
    "safe_sqrt",
    "score_candidates",
    "score_grid",
    "soft_match",
    "value",
]
