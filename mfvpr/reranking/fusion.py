"""Rankings by every system: retrieval alone, each scorer, and fusions of several scores."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mfvpr.reranking.cohort_normalization import by_hubness
from mfvpr.reranking.frame_correlation import FrameCorrelation
from mfvpr.reranking.ranking import (
    RetrievalScore,
    Scores,
    Ties,
    fuse_scales,
    fuse_shortlist,
    rank_shortlist,
    retrieval_scores,
)  # fmt: skip
from mfvpr.reranking.results import COHORT, FRAMES, RETRIEVAL, Ranked
from mfvpr.scoring.fields import POSITIVE
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError, require_word


@dataclass(frozen=True)
class Fusion:
    """Sum of a main score, the retrieval score, and the scores of further scorers.

    Attributes:
        c: the combined score is main score + c * retrieval score; None = `balancing_c` of each query. "zscore" = the
            sum of all scores, each with mean 0 and standard deviation 1 over the query's candidates (0 if all are
            equal). With retrieval and main score only, "zscore" ranks as None does, but its values have the same unit
            for every query. A score that is not finite affects only its own candidate.
        retrieval_score: kind of retrieval score, see `mfvpr.reranking.ranking.retrieval_scores`.
        weights: for "zscore" only, above 0, by name: of `retrieval` and of the main scorer, by default 1;
            and of further scorers, which take part only if they are named here.
    """

    c: float | Literal["zscore"] | None = None
    retrieval_score: RetrievalScore = "cosine"
    weights: Mapping[str, float] = field(default_factory=dict)

    def members(self, main: str) -> list[str]:
        """Names of the scorers that take part, the main scorer first."""
        return [main, *(name for name in self.weights if name not in (main, RETRIEVAL))]

    def rename_main(self, main: str, name: str) -> "Fusion":
        """This fusion for a main scorer with another name, such as one with a cohort."""
        return replace(self, weights={name if key == main else key: weight for key, weight in self.weights.items()})

    def system(self, main: str) -> str:
        """Name of the fused system, such as `histogram + retrieval`."""
        return " + ".join([*self.members(main), RETRIEVAL])

    def check(self, main: str, scorers: Collection[str]) -> None:
        """Check the settings and the names of scorers.

        Args:
            main: name of the main scorer.
            scorers: names of all scorers.

        Raises:
            InputError: a setting is out of bounds, or a name is not among the scorers.
        """
        require_word("retrieval_score", self.retrieval_score, RetrievalScore)
        known = ", ".join(scorers) or "there are none"
        if main not in scorers:
            raise InputError(f"fused: expected names of scorers ({known}), got {main}")
        if self.c not in (None, "zscore") and not _between(self.c, 0, POSITIVE[1]):
            raise InputError(f"c={self.c!r}: expected a number from 0 to {POSITIVE[1]:g}, 'zscore', or None")
        if self.weights and self.c != "zscore":
            raise InputError(f"weights: expected c='zscore' as well, got c={self.c!r}")
        for name, weight in self.weights.items():
            if name not in {RETRIEVAL, *scorers}:
                raise InputError(f"weights: expected {RETRIEVAL} or scorers ({known}), got {name}; score by it "
                                 "as well")  # fmt: skip
            if not _between(weight, *POSITIVE):
                raise InputError(f"weights: expected numbers from {POSITIVE[0]:g} to {POSITIVE[1]:g}, got {name}="
                                 f"{weight!r}")  # fmt: skip

    def __call__(self, main: str, candidates: Shortlist, scores: Mapping[str, Scores]) -> Scores:
        """Combined scores, from scores by name of the scorer."""
        if self.c != "zscore":
            return fuse_shortlist(candidates, scores[main], self.c, retrieval_score=self.retrieval_score)
        parts = {RETRIEVAL: retrieval_scores(candidates, self.retrieval_score)}
        parts |= {name: scores[name] for name in self.members(main)}
        weights = np.array([self.weights.get(name, 1.0) for name in parts], np.float32)
        return np.asarray(fuse_scales(np.stack([*parts.values()], axis=-1), candidates.mask, weights))


def rank_by_systems(
    candidates: Shortlist, scores: Mapping[str, Scores], fused: Mapping[str, Fusion],
    correlated: Mapping[str, FrameCorrelation], ties: Ties, *,
    hubness: Mapping[str, Float[np.ndarray, " database"]] | None = None,
) -> dict[str, Ranked]:  # fmt: skip
    """Rankings of queries by name of the system.

    Args:
        candidates: of the queries, which are a sequence if scores are correlated.
        scores: by name of the scorer.
        fused, correlated, ties: see `mfvpr.System`.
        hubness: by name of the scorer; None = no score normalization with a cohort.
    """
    scores = {**scores}
    for name, strengths in (hubness or {}).items():
        scores[f"{name} + {COHORT}"] = by_hubness(candidates, scores[name], strengths, name=name)
    scores |= {fusion.system(name): fusion(name, candidates, scores) for name, fusion in fused.items()}
    scores |= {f"{name} + {FRAMES}": correlate(candidates, scores[name]) for name, correlate in correlated.items()}
    scores = {RETRIEVAL: candidates.scores} | scores
    return {name: _rank(candidates, values, ties) for name, values in scores.items()}


def _between(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float | np.number) and bool(low <= value <= high)


def _rank(candidates: Shortlist, scores: Scores, ties: Ties) -> Ranked:
    order = rank_shortlist(candidates, scores, ties=ties)
    return Ranked(*(np.take_along_axis(values, order, axis=1) for values in (candidates.indices, scores)))
