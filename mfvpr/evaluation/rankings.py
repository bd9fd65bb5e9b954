"""Matches and rankings of a sequence of queries."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.evaluation.shortlist_scores import Scores
from mfvpr.matchers.match_set import MatchSet, Scales

RETRIEVAL = "retrieval"  # name of the retrieval's own ranking
SEQUENCE = "sequence"  # in names of rankings by the motion along a drive
FRAMES = "frames"  # in names of rankings by frame correlation, which uses the queries before


@dataclass(frozen=True, repr=False)
class Matched:
    """Candidates of the Q queries of a sequence, and their matches."""

    sequence: QuerySequence
    candidates: Shortlist
    matches: tuple[MatchSet, ...]  # of each scale
    bad_queries: Mapping[int, str]  # row -> reason, of images that could not be used
    bad_database: Mapping[int, str]
    weights: tuple[float, ...] | None = None  # of the scales; None = 1 each

    def __repr__(self) -> str:
        return f"Matched({self.sequence!r}, {self.candidates.indices.shape[1]} candidates each)"

    @property
    def by_scale(self) -> MatchSet | Scales:
        """Input of scoring; several scales are fused, each standardized over a query's candidates."""
        return self.matches[0] if len(self.matches) == 1 else Scales(self.matches, self.weights)


@dataclass(frozen=True, repr=False)
class Ranked:
    """Ranking of the candidates of a sequence."""

    rows: Int[np.ndarray, "queries candidates"]  # of the database, best first; -1 = none
    scores: Scores  # in this order

    def __repr__(self) -> str:
        return "Ranked({} queries, {} candidates each)".format(*self.rows.shape)

    @property
    def shortlist(self) -> Shortlist:
        """The ranking as a shortlist, to be written (`mfvpr.io.write_shortlist`) or matched again."""
        mask = self.rows >= 0
        return Shortlist(indices=self.rows, scores=np.where(mask, self.scores, 0), mask=mask)
