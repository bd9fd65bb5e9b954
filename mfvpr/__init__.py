"""Model-free re-ranking for visual place recognition.

Images become features; features become a shortlist and matches; matches become scores; scores become a ranking;
rankings become recall. `evaluate` runs all stages on a data set; `Map` localizes one image at a time. The other names
are the single stages as functions of arrays. The packages add images, files and caches. `value`, `Scorer` and the names
after them are for a scorer of your own; `mfvpr.testing.check_scorer` tests its contract.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mfvpr.datasets.positives import frame_positives, radius_positives
from mfvpr.evaluation.recall import recall_at_k
from mfvpr.matching.lightglue import LightGlueMatcher
from mfvpr.matching.matcher import Matcher, NearestNeighborMatcher, match_pairs
from mfvpr.matching.nearest_neighbors import compact, filter_matches, match, match_candidates
from mfvpr.matching.soft import soft_match
from mfvpr.reranking.grids import score_grid
from mfvpr.reranking.ranking import balancing_c, combine, rank, rerank, score_candidates
from mfvpr.retrieval.search import retrieve
from mfvpr.scoring import (
    AggregatedScore,
    AnchorPoints,
    GridAnchors,
    HistogramOfShifts,
    Homography,
    LostScore,
    MatchCount,
    OpenCvHomography,
    RapidSpatialScore,
    Scorer,
    ShiftHistogram,
    VisualPhrases,
    image_sizes,
    match_shifts,
)
from mfvpr.scoring.weights import (
    DescriptorDistanceWeight,
    FeatureScoreWeight,
    RatioWeight,
    UnitWeight,
    Weight,
    match_weights,
)
from mfvpr.types import Features, Matches, Ranking, Shortlist, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import masked, masked_mean, masked_median, safe_sqrt
from mfvpr.utils.runtime import Runtime

if TYPE_CHECKING:
    from mfvpr.evaluation import Pipeline, System, evaluate
    from mfvpr.localization import Map

__version__ = "0.2.0"

__all__ = [  # noqa: RUF022 (in the order of the stages)
    # values that pass from stage to stage
    "Features", "Matches", "Ranking", "Shortlist",
    # shortlists from global descriptors
    "retrieve",
    # matches of two images, and of a query with its candidates
    "match", "match_candidates", "match_pairs", "compact", "filter_matches", "soft_match",
    "Matcher", "NearestNeighborMatcher", "LightGlueMatcher",
    # weights of matches
    "DescriptorDistanceWeight", "FeatureScoreWeight", "RatioWeight", "UnitWeight", "Weight", "match_weights",
    # scores of one pair
    "AggregatedScore", "AnchorPoints", "GridAnchors", "HistogramOfShifts", "Homography", "LostScore", "MatchCount",
    "OpenCvHomography", "RapidSpatialScore", "ShiftHistogram", "VisualPhrases",
    # scores of all candidates, whole grids of parameters, fusion and ranking
    "score_candidates", "score_grid", "balancing_c", "combine", "rank", "rerank",
    # what is correct, and recall
    "frame_positives", "radius_positives", "recall_at_k",
    # a whole data set, and one image at a time
    "evaluate", "Map", "Pipeline", "System", "Runtime",
    # tools for a scorer of your own; see mfvpr.testing.check_scorer
    "Scorer", "value", "image_sizes", "match_shifts", "masked", "masked_mean", "masked_median", "safe_sqrt",
    # mistakes of a caller, in one line
    "InputError",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what works on images at its first use: images take longer to import than arrays."""
    packages = {"Map": "localization"} | dict.fromkeys(["Pipeline", "System", "evaluate"], "evaluation")
    if name not in packages:
        raise AttributeError(f"module 'mfvpr' has no attribute {name!r}")
    return getattr(import_module(f"mfvpr.{packages[name]}"), name)
