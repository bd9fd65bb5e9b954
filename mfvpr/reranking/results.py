"""Matches and rankings of a sequence of queries."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mfvpr.datasets.datasets import QuerySequence
from mfvpr.matching.match_set import MatchSet, Scales
from mfvpr.types import Shortlist

FILTER = "filter"  # the name of the filter's own ranking
FRAMES = "frames"  # in the names of those that the queries before take part in
COHORT = "cohort"  # in the names of those that other places of the map take part in


@dataclass(frozen=True)
class Matched:
    """A sequence's candidates, and their matches by scale; `weights` of the scales, None = 1 each."""

    sequence: QuerySequence
    candidates: Shortlist
    matches: tuple[MatchSet, ...]
    bad_queries: Mapping[int, str]
    bad_database: Mapping[int, str]
    weights: tuple[float, ...] | None = None

    @property
    def by_scale(self) -> MatchSet | Scales:
        """What is scored: several scales are fused, each standardized over a query's candidates."""
        return self.matches[0] if len(self.matches) == 1 else Scales(self.matches, self.weights)


@dataclass(frozen=True)
class Ranked:
    """A system's ranking of a sequence: database rows `[Q, C]`, best first, and their scores in that order."""

    rows: np.ndarray
    scores: np.ndarray

    @property
    def shortlist(self) -> Shortlist:
        """The same, to be written (`mfvpr.io.write_shortlist`) or matched again."""
        there = self.rows >= 0
        return Shortlist(indices=self.rows, scores=np.where(there, self.scores, 0), mask=there)
