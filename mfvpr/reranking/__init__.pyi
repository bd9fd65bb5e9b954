__all__ = [
    "Drive",
    "DriveFilter",
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

from .drives import Drive
from .fusion import FinalScore, FrameCorrelation, Fusion
from .grids import score_grid
from .ranking import balancing_c, combine, fuse_scales, rank, rerank, score_candidates
from .results import Matched, Ranked
from .sequences import DriveFilter
