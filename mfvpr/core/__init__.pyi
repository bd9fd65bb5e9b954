__all__ = [
    "AggregatedScore",
    "AnchorPoints",
    "CrossCheck",
    "Features",
    "HistogramOfShifts",
    "MatchCount",
    "Matches",
    "Ranking",
    "Scorer",
    "ShiftHistogram",
    "Shortlist",
    "combine",
    "compact",
    "filter_matches",
    "hits",
    "image_sizes",
    "match",
    "match_candidates",
    "match_shifts",
    "rank",
    "recall_at_k",
    "rerank",
    "score_candidates",
    "score_grid",
]

from .aggregate import AggregatedScore, MatchCount
from .anchor import AnchorPoints
from .batch import score_candidates, score_grid
from .histogram import HistogramOfShifts, ShiftHistogram
from .matching import compact, filter_matches, match, match_candidates
from .metrics import hits, recall_at_k
from .nearest import CrossCheck
from .ranking import combine, rank, rerank
from .scorer import Scorer
from .types import Features, Matches, Ranking, Shortlist
from .weights import image_sizes, match_shifts
