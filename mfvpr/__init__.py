"""Model-free re-ranking for visual place recognition.

Images become features; features become a shortlist and matches; matches become scores; scores become a ranking;
rankings become recall. `evaluate` goes the whole way over a data set, a `Map` is asked with one image at a time; the
other names below are the core of that sentence, on arrays. The packages put it to work on images and files. `value`,
`Scorer` and what follows from them is what a scorer of your own is written with; `mfvpr.testing.check_scorer` says
whether it keeps the contract.
"""

from typing import TYPE_CHECKING, Any

from mfvpr.datasets.positives import frame_positives, radius_positives
from mfvpr.evaluation.recall import recall_at_k
from mfvpr.matching.lightglue import LightGlueMatching
from mfvpr.matching.matcher import Matcher, Matching, match_pairs
from mfvpr.matching.nearest_neighbors import compact, filter_matches, match, match_candidates
from mfvpr.matching.soft import soft_match
from mfvpr.reranking.grids import score_grid
from mfvpr.reranking.ranking import balancing_c, combine, rank, rerank, score_candidates
from mfvpr.retrieval.search import retrieve
from mfvpr.scoring.aggregate import AggregatedScore
from mfvpr.scoring.anchor import AnchorPoints
from mfvpr.scoring.counting import MatchCount
from mfvpr.scoring.grid import GridAnchors
from mfvpr.scoring.histogram import HistogramOfShifts, ShiftHistogram
from mfvpr.scoring.homography import Homography
from mfvpr.scoring.homography_opencv import OpenCvHomography
from mfvpr.scoring.lost import LostScore
from mfvpr.scoring.phrases import VisualPhrases
from mfvpr.scoring.rapid import RapidSpatialScore
from mfvpr.scoring.scorer import Scorer
from mfvpr.scoring.shifts import image_sizes, match_shifts
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

if TYPE_CHECKING:
    from mfvpr.evaluation.evaluation import evaluate
    from mfvpr.localization.map import Map

__version__ = "0.2.0"

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
    "LightGlueMatching",
    "LostScore",
    "Map",
    "MatchCount",
    "Matcher",
    "Matches",
    "Matching",
    "OpenCvHomography",
    "Ranking",
    "RapidSpatialScore",
    "RatioWeight",
    "Scorer",
    "ShiftHistogram",
    "Shortlist",
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


def __getattr__(name: str) -> Any:
    """`evaluate` and `Map`, once they are asked for: images take longer to import than arrays."""
    if name not in ("evaluate", "Map"):
        raise AttributeError(f"module 'mfvpr' has no attribute {name!r}")
    from mfvpr.evaluation.evaluation import evaluate
    from mfvpr.localization.map import Map

    return evaluate if name == "evaluate" else Map
