"""Rankings of a sequence by every system: the filter alone, each scorer, and what is made of several scores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mfvpr import pipeline
from mfvpr.cohort import by_hubness
from mfvpr.frame_correlation import FrameCorrelation
from mfvpr.numerics import Device
from mfvpr.progress import Track, untracked
from mfvpr.reranking import FilterScore, Ties, fuse_shortlist, rank_shortlist
from mfvpr.results import COHORT, FILTER, FRAMES, Matched, Ranked
from mfvpr.scoring import Scorer
from mfvpr.types import Shortlist


@dataclass(frozen=True)
class Fusion:
    """How the filter's score is added to another: `c` times (None = as much as balances both per query), and which."""

    c: float | None = None
    filter_score: FilterScore = "cosine"


def rank_sequence(
    matched: Matched,
    scorers: Mapping[str, Scorer],
    fused: Mapping[str, Fusion],
    correlated: Mapping[str, FrameCorrelation],
    ties: Ties,
    *,
    hubness: Mapping[str, np.ndarray] | None = None,
    devices: Sequence[Device] | None = None,
    track: Track = untracked,
) -> dict[str, Ranked]:
    """Rankings of a sequence by name of the system, see `mfvpr.evaluate`; `hubness` `[N]` is by name of the scorer."""
    candidates = matched.candidates
    scores = pipeline.score(scorers, matched.by_scale, candidates, devices=devices, track=track)
    scores |= {
        f"{name} + {COHORT}": by_hubness(candidates, scores[name], strengths, who=name)
        for name, strengths in (hubness or {}).items()
    }
    scores |= {
        f"{name} + {FILTER}": fuse_shortlist(candidates, scores[name], how.c, filter_score=how.filter_score)
        for name, how in fused.items()
    }
    scores |= {f"{name} + {FRAMES}": how(candidates, scores[name]) for name, how in correlated.items()}
    return {name: _ranked(candidates, values, ties) for name, values in ({FILTER: candidates.scores} | scores).items()}


def _ranked(candidates: Shortlist, scores: np.ndarray, ties: Ties) -> Ranked:
    order = rank_shortlist(candidates, scores, ties=ties)
    return Ranked(*(np.take_along_axis(values, order, axis=1) for values in (candidates.indices, scores)))
