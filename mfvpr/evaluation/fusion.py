"""Final scores of a system, which candidates are ranked by: of retrieval, of each scorer, and combined ones."""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from mfvpr.core.types import Shortlist
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.rankings import (
    FRAMES,
    RETRIEVAL,
    Ranked,
    RetrievalScore,
    Scores,
    Ties,
    fuse_scales,
    fuse_shortlist,
    retrieval_scores,
)
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.fields import NOT_NEGATIVE, POSITIVE


@dataclass(frozen=True)
class Fusion:
    """Sum of a main score, the retrieval score, and the scores of further scorers.

    Attributes:
        c: the combined score is main score + c * retrieval score; None = `balancing_c` of each query. "zscore" = the
            sum of all scores, each with mean 0 and standard deviation 1 over the query's candidates (0 if all are
            equal). With retrieval and main score only, "zscore" ranks finite scores as None does, but its values have
            the same unit for every query. A score that is not finite affects only its own candidate.
        retrieval_score: kind of retrieval score, see `mfvpr.evaluation.rankings.retrieval_scores`.
        weights: for "zscore" only, above 0, by name: of `retrieval` and of the main scorer, by default 1;
            and of further scorers, which take part only if they are named here.
    """

    c: float | Literal["zscore"] | None = None
    retrieval_score: RetrievalScore = "cosine"
    weights: Mapping[str, float] = field(default_factory=dict)

    def members(self, main: str) -> list[str]:
        """Names of the scorers that take part, the main scorer first."""
        return [main, *(name for name in self.weights if name not in (main, RETRIEVAL))]

    def system(self, main: str) -> str:
        """Name of the fused system, such as `histogram + retrieval`."""
        return " + ".join([*self.members(main), RETRIEVAL])

    def check(self, main: str, scorers: Collection[str]) -> None:
        """Raise an InputError if a setting is out of bounds, or a name is not among those of all `scorers`."""
        require_word("retrieval_score", self.retrieval_score, RetrievalScore)
        known = ", ".join(scorers) or "there are none"
        if main not in scorers:
            raise InputError(f"fused: expected names of scorers ({known}), got {main}")
        if self.c not in (None, "zscore") and not NOT_NEGATIVE.holds(self.c):
            raise InputError(f"c={self.c!r}: expected {NOT_NEGATIVE.expected}, 'zscore', or None")
        if self.weights and self.c != "zscore":
            raise InputError(f"weights: expected c='zscore' as well, got c={self.c!r}")
        for name, weight in self.weights.items():
            if name not in {RETRIEVAL, *scorers}:
                raise InputError(f"weights: expected {RETRIEVAL} or scorers ({known}), got {name}; score by it as well")
            POSITIVE.check(f"weights.{name}", weight)

    def __call__(self, main: str, candidates: Shortlist, scores: Mapping[str, Scores]) -> Scores:
        """Combined scores, from scores by name of the scorer."""
        if self.c != "zscore":
            return fuse_shortlist(candidates, scores[main], self.c, retrieval_score=self.retrieval_score)
        parts = {RETRIEVAL: retrieval_scores(candidates, self.retrieval_score)}
        parts |= {name: scores[name] for name in self.members(main)}
        weights = np.array([self.weights.get(name, 1.0) for name in parts], np.float32)
        return np.asarray(fuse_scales(np.stack([*parts.values()], axis=-1), candidates.mask, weights))


@dataclass(frozen=True)
class FrameCorrelation:
    """Increase the scores of candidates near the places of the previous queries (Camara & Preucil, RAS 2020).

    The place of a query is its best candidate. A candidate d database rows from the place of a previous query gains
    strength * gain * (1 - d / reach) of its score; the largest gain over the previous queries counts. The strength is
    the score of that place over the best score of the previous places, and 1 if `previous` is 1 or all scores are 0.
    Queries and database images must be in the order of the drive.

    The public code differs in two details: it rounds the scores of places to two digits, and it assigns row 0 to a
    query without a score above 0, which has no place here.

    Attributes:
        previous: number of previous queries, from 1; the first `previous` queries keep their scores.
        reach: database rows.
        gain: largest relative increase of a score.
    """

    previous: int = 2
    reach: float = 15.0
    gain: float = 0.4

    def __post_init__(self) -> None:
        if self.previous < 1 or not 0 < self.reach < np.inf or not 0 <= self.gain < np.inf:
            expected = "at least one query, a finite reach above 0, a finite gain from 0"
            raise InputError(f"{self}: expected {expected}")

    def __call__(self, candidates: Shortlist, scores: Scores) -> Scores:
        """Correlated scores of a sequence, float32.

        Scores that are not above 0, and NaN, stay the same. Among equal scores the lowest row is the query's place.
        """

        def gains(rows: np.ndarray, before: Float[np.ndarray, "previous 2"]) -> np.ndarray:
            """Largest relative gains of rows; `before` are places and scores."""
            places, scores = before.T
            best = scores.max()
            strength = scores / best if best > 0 and self.previous > 1 else np.ones(len(scores))
            nearness = np.maximum(1 - np.abs(rows[:, None] - places) / self.reach, 0)
            return self.gain * np.max(strength * nearness, axis=1, initial=0)

        mask, correlated = np.asarray(candidates.mask), np.array(scores, np.float64)
        before: deque[tuple[float, float]] = deque(maxlen=self.previous)  # (row, score) of the last places
        for row_scores, rows, usable in zip(correlated, np.asarray(candidates.indices, float), mask, strict=True):
            positive = usable & (row_scores > 0)
            if len(before) == self.previous:
                row_scores[positive] *= 1 + gains(rows[positive], np.array(before))
            best = row_scores.max(where=positive, initial=0)
            before.append((rows.min(where=positive & (row_scores == best), initial=np.inf), best))
        return correlated.astype(np.float32)


@dataclass(frozen=True)
class FinalScore:
    """A score that candidates are ranked by: of the retrieval, of a scorer, or made of another final score."""

    name: str
    scorers: tuple[str, ...] = ()  # names of those that take part, the main one first; none = retrieval alone
    base: str = ""  # name of the final score that this one is made of, by `step`; "" = of retrieval or a scorer
    step: Fusion | FrameCorrelation | DriveFilter | None = None


def final_scores(
    scorers: Sequence[str],
    fused: Mapping[str, Fusion],
    correlated: Mapping[str, FrameCorrelation],
    sequences: Mapping[str, Sequence[DriveFilter]],
) -> dict[str, FinalScore]:
    """Final scores of a system by name, those that are made of other ones behind them; see `mfvpr.System`."""
    scores = [FinalScore(RETRIEVAL), *(FinalScore(name, (name,)) for name in scorers)]
    for name, fusion in fused.items():
        fusion.check(name, scorers)
        scores.append(FinalScore(fusion.system(name), tuple(fusion.members(name)), name, fusion))
    known = {score.name: score.scorers for score in scores[1:]}
    steps = [("correlated", name, FRAMES, correlation) for name, correlation in correlated.items()]
    for name, filters in sequences.items():
        if not isinstance(filters, list | tuple) or not all(isinstance(each, DriveFilter) for each in filters):
            raise InputError(f"sequences: expected a list of DriveFilter(...) for {name}, got {filters!r}")
        steps += [("sequences", name, each.name, each) for each in filters]
    for field_name, name, words, step in steps:
        if name not in known:
            names = ", ".join(known) or "there are none"
            raise InputError(f"{field_name}: expected names of scorers ({names}), got {name}")
        scores.append(FinalScore(f"{name} + {words}", known[name], name, step))
    by_name = {score.name: score for score in scores}
    if len(by_name) < len(scores):
        twice = next(score.name for score in scores if by_name[score.name] is not score)
        raise InputError(f"scorers: {twice} is the name of another system; choose another one")
    return by_name


def rank_by_scores(
    candidates: Shortlist,
    scores: Mapping[str, Scores],
    final_scores: Collection[FinalScore],
    ties: Ties,
    *,
    num_rows: int = 0,
    excluded: Bool[np.ndarray, "queries database"] | None = None,
) -> dict[str, Ranked]:
    """Rankings of queries by name of the final score, in the order of `final_scores`; a drive if it is a sequence.

    `scores` `[Q, C]` are by name of the scorer. Sequences need `num_rows`, the number of images in the database, and
    the images of it that are `excluded` for each query.
    """
    known = {RETRIEVAL: candidates.scores, **scores}
    rankings: dict[str, Ranked] = {}
    for score in final_scores:
        if isinstance(score.step, DriveFilter):
            rankings[score.name] = score.step(rankings[score.base], num_rows, excluded)
            continue
        if isinstance(score.step, Fusion):
            known[score.name] = score.step(score.base, candidates, known)
        elif isinstance(score.step, FrameCorrelation):
            known[score.name] = score.step(candidates, known[score.base])
        rankings[score.name] = Ranked.of(candidates, known[score.name], ties)
    return rankings
