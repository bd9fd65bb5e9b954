"""Half of a path to learn on: which queries teach, which validate, and what may be seen of their candidates."""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import numpy as np

from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.protocol import Judge
from mfvpr.evaluation.selection import Half, separated
from mfvpr.matching.match_set import MatchSet
from mfvpr.reranking.batched_scoring import score
from mfvpr.reranking.ranking import FilterScore, filter_scores
from mfvpr.scoring.scorer import Scorer
from mfvpr.types import Matches, Shortlist, value
from mfvpr.utils import ragged
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import round_up

VALIDATION = 0.25  # of the queries to learn on, the end of each path


@value
class Batch:
    """Queries to learn from, padded.

    matches: `[B, C, K, ...]`.  filter_scores: `[B, C]`.  positives, mask: `[B, C]` bool.
    """

    matches: Matches
    filter_scores: np.ndarray
    positives: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class TrainingSplit:
    """One half of the path to learn on.

    Attributes:
        match_set: matches of all Q queries.
        candidates: of all queries; their scores are the filter's part of a combined score.
        judge: what is right.
        half: where to choose and where to report.
        train: `[t]` queries of the losses.
        validation: `[v]` queries that stop the learning.
        seen: `[Q, C]` bool, candidates that learning may look at.
        name: of the half.
    """

    match_set: MatchSet
    candidates: Shortlist
    judge: Judge
    half: Half
    train: np.ndarray
    validation: np.ndarray
    seen: np.ndarray
    name: str

    @cached_property
    def right(self) -> np.ndarray:
        """`[Q, C]` bool, candidates that are right within the threshold that decides."""
        return self._positive(self.judge.positives[self.judge.main])

    @cached_property
    def usable(self) -> np.ndarray:
        """`[Q, C]` bool, candidates of the losses: seen, and not right by the widest threshold alone."""
        return self.seen & ~(self._positive(self.judge.positives[-1]) & ~self.right)

    def _positive(self, positives: Positives) -> np.ndarray:
        return positives.contains(self.candidates.indices) & self.candidates.mask

    @cached_property
    def width(self) -> int:
        """Candidates that hold every query's usable ones."""
        most = int(self.usable[self.half.tune].sum(axis=1).max())
        return min(round_up(most, 8), self.usable.shape[1])

    def part(self, queries: np.ndarray) -> tuple[MatchSet, Shortlist]:
        """Matches and candidates of some queries."""
        return self.match_set.take(queries), jax.tree.map(lambda values: values[queries], self.candidates)

    def batch(self, queries: np.ndarray, size: int) -> Batch:
        """Some queries, padded to `size`; padding has no candidates, and what is no candidate has no matches."""
        padded = ragged.filled(queries, size)
        places = np.argsort(~self.usable[padded], axis=1, kind="stable")[:, : self.width]
        take = partial(np.take_along_axis, indices=places, axis=1)
        mask = take(self.usable[padded]) & (np.arange(size) < len(queries))[:, None]
        pairs = self.match_set.pairs(np.repeat(padded, self.width), places.reshape(-1), self.match_set.capacity)
        matches: Matches = jax.tree.map(lambda values: values.reshape(*places.shape, *values.shape[1:]), pairs)
        matches = replace(matches, mask=matches.mask & mask[..., None])
        return Batch(matches, take(self.candidates.scores[padded]), take(self.right[padded]), mask)

    def spread(self, scorer: Scorer) -> float:
        """Standard deviation of the scores that learning may see; 1 where all are equal."""
        scores = score({"it": scorer}, *self.part(self.train))["it"]
        return float(np.std(scores[self.seen[self.train]])) or 1.0

    def balance(self, spread: float) -> float:
        """The c that gives the filter's scores the same spread; 0 where all are equal."""
        deviation = float(np.std(self.candidates.scores[self.train][self.seen[self.train]]))
        return spread / deviation if deviation else 0.0


def training_splits(
    match_set: MatchSet, candidates: Shortlist, judge: Judge, *, filter_score: FilterScore = "cosine"
) -> list[TrainingSplit]:
    """The halves of a judge, each to be learned on.

    Args:
        match_set: matches of Q queries with C candidates.
        candidates: their shortlist.
        judge: what is right, with halves.
        filter_score: the filter's part of a combined score, see `mfvpr.reranking.ranking.filter_scores`.

    Raises:
        InputError: the judge has no halves, or one has no queries that teach, or none to validate with.
    """
    if not judge.halves:
        raise InputError("split=None: expected first_half, second_half or both, since what is learned is never "
                         "reported on the same queries")  # fmt: skip
    candidates = replace(candidates, scores=filter_scores(candidates, filter_score))
    split = partial(_split, match_set, candidates, judge)
    return [split(half, name) for half, name in zip(judge.halves, judge.names, strict=True)]


def _split(match_set: MatchSet, candidates: Shortlist, judge: Judge, half: Half, name: str) -> TrainingSplit:
    paths = np.split(half.tune, np.cumsum(half.paths[:-1]).astype(int)) if half.paths else [half.tune]
    pieces = [np.split(path, [len(path) - round(VALIDATION * len(path))]) for path in paths]
    apart = separated(judge.places, *(np.concatenate(same) for same in zip(*pieces, strict=True)))
    seen = candidates.mask & half.allowed[np.maximum(candidates.indices, 0)]
    split = TrainingSplit(match_set, candidates, judge, half, apart.tune, apart.report, seen, name)
    right, wrong = split.right & split.usable, ~split.right & split.usable
    teaches = np.asarray(right.any(axis=1) & wrong.any(axis=1))  # the loss of others is 0, whatever the scores
    train, validation = apart.tune[teaches[apart.tune]], apart.report[teaches[apart.report]]
    if not len(train) or not len(validation):
        raise InputError(
            f"split={name}: expected queries to learn on and to validate with, got {len(train)} and "
            f"{len(validation)}; use more queries or candidates"
        )
    return replace(split, train=train, validation=validation)
