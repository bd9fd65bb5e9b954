"""Model-free re-ranking for visual place recognition.

Images become features; features become a shortlist and matches; matches become scores; scores become a ranking;
rankings become recall. The names below are the core of that sentence, on arrays; `mfvpr.data`, `mfvpr.features`,
`mfvpr.pipeline` and `mfvpr.report` put it to work on images and files.
"""

from mfvpr.errors import InputError
from mfvpr.evaluation import frame_positives, radius_positives, recall_at_k
from mfvpr.matching import compact, filter_matches, match, match_candidates, soft_match
from mfvpr.reranking import balancing_c, combine, rank, rerank, score_candidates, score_grid
from mfvpr.retrieval import retrieve
from mfvpr.scoring import AggregatedScore, AnchorPoints, HistogramOfShifts, MatchCount, ShiftHistogram
from mfvpr.types import Features, Matches, Ranking, Shortlist, value
from mfvpr.weighting import DescriptorDistanceWeight, FeatureScoreWeight, UnitWeight

__version__ = "0.1.0"

__all__ = [
    "AggregatedScore",
    "AnchorPoints",
    "DescriptorDistanceWeight",
    "FeatureScoreWeight",
    "Features",
    "HistogramOfShifts",
    "InputError",
    "MatchCount",
    "Matches",
    "Ranking",
    "ShiftHistogram",
    "Shortlist",
    "UnitWeight",
    "balancing_c",
    "combine",
    "compact",
    "filter_matches",
    "frame_positives",
    "match",
    "match_candidates",
    "radius_positives",
    "rank",
    "recall_at_k",
    "rerank",
    "retrieve",
    "score_candidates",
    "score_grid",
    "soft_match",
    "value",
]
