__all__ = [
    "AggregatedScore",
    "AnchorPoints",
    "CrossCheck",
    "HistogramOfShifts",
    "MatchCount",
    "Scorer",
    "ShiftHistogram",
    "balancing_c",
    "combine",
    "compact",
    "filter_matches",
    "fuse_scales",
    "hits",
    "image_sizes",
    "match",
    "match_candidates",
    "match_shifts",
    "precision_recall",
    "rank",
    "recall_at_k",
    "reliability",
    "rerank",
    "score_candidates",
    "score_grid",
]

from .aggregate import AggregatedScore
from .anchor import AnchorPoints
from .counting import MatchCount
from .grids import score_grid
from .histogram import HistogramOfShifts, ShiftHistogram
from .metrics import hits, precision_recall, recall_at_k, reliability
from .nearest_neighbors import CrossCheck, compact, filter_matches, match, match_candidates
from .ranking import balancing_c, combine, fuse_scales, rank, rerank, score_candidates
from .scorer import Scorer
from .shifts import image_sizes, match_shifts
