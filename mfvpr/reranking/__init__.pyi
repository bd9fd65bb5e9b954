__all__ = [
    "FinalScore",
    "FrameCorrelation",
    "Fusion",
    "Matched",
    "Ranked",
    "balancing_c",
    "combine",
    "fuse_scales",
    "rank",
    "rerank",
    "score_candidates",
    "score_grid",
]

from .fusion import FinalScore, FrameCorrelation, Fusion
from .grids import score_grid
from .ranking import balancing_c, combine, fuse_scales, rank, rerank, score_candidates
from .results import Matched, Ranked
