"""Queries to train on and to validate on, of one half of a path or of several joined data sets."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.core.scorer import Scorer
from mfvpr.core.types import Array, Matches, Shortlist, per_pair, value
from mfvpr.datasets.positives import Positives, join_positives
from mfvpr.evaluation.protocol import EvaluationProtocol, Half, separate
from mfvpr.evaluation.rankings import RetrievalScore, retrieval_scores
from mfvpr.evaluation.stages import score
from mfvpr.matchers.match_set import MatchSet
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import repeat_last, round_up

VALIDATION = 0.25  # of the queries to learn on, the end of each path


@value
class Batch:
    """Queries to learn from, padded; matches `[queries, candidates, slots, ...]`."""

    matches: Matches
    retrieval_scores: Float[Array, "queries candidates"]
    positives: Bool[Array, "queries candidates"]
    mask: Bool[Array, "queries candidates"]


@dataclass(frozen=True)
class TrainingSplit:
    """One half of the path to learn on; matches, candidates and ground truth are those of all queries."""

    match_set: MatchSet
    candidates: Shortlist  # their scores are the retrieval's part of a combined score
    protocol: EvaluationProtocol
    half: Half
    train: Int[np.ndarray, " train"]  # queries of the losses
    validation: Int[np.ndarray, " validation"]  # queries that decide when learning stops
    seen: Bool[np.ndarray, "queries candidates"]  # candidates that learning may use
    name: str

    @cached_property
    def correct(self) -> Bool[np.ndarray, "queries candidates"]:
        """Correct candidates at the main threshold."""
        return self._positive(self.protocol.positives[self.protocol.main])

    @cached_property
    def usable(self) -> Bool[np.ndarray, "queries candidates"]:
        """Candidates of the losses: seen, and not correct at the widest threshold only."""
        return self.seen & ~(self._positive(self.protocol.positives[-1]) & ~self.correct)

    def _positive(self, positives: Positives) -> np.ndarray:
        return positives.contains(self.candidates.indices) & self.candidates.mask

    @cached_property
    def width(self) -> int:
        """Number of candidates of a batch, which holds the usable candidates of every query."""
        most = int(self.usable[self.half.tune].sum(axis=1).max())
        return min(round_up(most, 8), self.usable.shape[1])

    def part(self, queries: Int[np.ndarray, " part"]) -> tuple[MatchSet, Shortlist]:
        """Matches and candidates of some queries."""
        return self.match_set.take(queries), jax.tree.map(lambda values: values[queries], self.candidates)

    def batch(self, queries: Int[np.ndarray, " batch"], size: int) -> Batch:
        """A batch of queries, padded to `size` with queries without candidates."""
        padded = repeat_last(queries, size)
        places = np.argsort(~self.usable[padded], axis=1, kind="stable")[:, : self.width]
        take = partial(np.take_along_axis, indices=places, axis=1)
        mask = take(self.usable[padded]) & (np.arange(size) < len(queries))[:, None]
        pairs = self.match_set.pairs(np.repeat(padded, self.width), places.reshape(-1), self.match_set.capacity)
        matches: Matches = jax.tree.map(lambda values: values.reshape(*places.shape, *values.shape[1:]), pairs)
        matches = replace(matches, mask=matches.mask & mask[..., None])
        return Batch(matches, take(self.candidates.scores[padded]), take(self.correct[padded]), mask)

    def score_deviation(self, scorer: Scorer) -> float:
        """Standard deviation of the scores that learning may use; 1 if all are equal."""
        scores = score({"scorer": scorer}, *self.part(self.train))["scorer"]
        return float(np.std(scores[self.seen[self.train]])) or 1.0

    def balance(self, deviation: float) -> float:
        """The c that gives the retrieval's scores a standard deviation; 0 if they are all equal."""
        of_retrieval = float(np.std(self.candidates.scores[self.train][self.seen[self.train]]))
        return deviation / of_retrieval if of_retrieval else 0.0


def training_splits(
    match_set: MatchSet,
    candidates: Shortlist,
    protocol: EvaluationProtocol,
    *,
    retrieval_score: RetrievalScore = "cosine",
) -> list[TrainingSplit]:
    """Split each half of a protocol into queries to train on and queries to validate on.

    An InputError if the protocol has no halves, or a half has no usable queries to train on or to validate on.
    """
    if not protocol.halves:
        reason = "since what is learned is never reported on the same queries"
        raise InputError(f"split=None: expected first_half, second_half or both, {reason}")
    candidates = replace(candidates, scores=retrieval_scores(candidates, retrieval_score))
    splits = []
    for half, seen, name in zip(protocol.halves, protocol.of(candidates).views[1:], protocol.names, strict=True):
        paths = np.split(half.tune, np.cumsum(half.paths[:-1]).astype(int)) if half.paths else [half.tune]
        pieces = [np.split(path, [len(path) - round(VALIDATION * len(path))]) for path in paths]
        apart = separate(protocol.places, *(np.concatenate(parts) for parts in zip(*pieces, strict=True)))
        split = TrainingSplit(match_set, candidates, protocol, half, apart.tune, apart.report, seen, name)
        correct, incorrect = split.correct & split.usable, ~split.correct & split.usable
        has_both = np.asarray(correct.any(axis=1) & incorrect.any(axis=1))  # else the loss is 0 for any scores
        train, validation = (rows[has_both[rows]] for rows in (apart.tune, apart.report))
        if not len(train) or not len(validation):
            got = f"{len(train)} and {len(validation)}; use more queries or candidates"
            raise InputError(f"split={name}: expected queries to learn on and to validate with, got {got}")
        splits.append(replace(split, train=train, validation=validation))
    return splits


@dataclass(frozen=True)
class Part:
    """One data set: ground truth, matches and shortlist of all queries."""

    name: str
    protocol: EvaluationProtocol
    match_set: MatchSet
    candidates: Shortlist


def join_data_sets(teach: Sequence[Part], report: Sequence[Part]) -> Part:
    """Join data sets to one, whose protocol learns on the first sets and reports on the others.

    An InputError if two sets have the same name, or units or thresholds differ.
    """
    parts = [*teach, *report]
    names, first = [part.name for part in parts], parts[0]
    if len({*names}) < len(names):
        raise InputError(f"expected data sets of different names, got {', '.join(names)}")
    for part in parts:
        expected, got = ((each.protocol.unit, each.protocol.thresholds) for each in (first, part))
        if expected != got:
            words = "unit {} with thresholds {}".format
            raise InputError(f"{part.name}: expected {words(*expected)} as {first.name} has, got {words(*got)}")
    sizes, databases = ([len(part.match_set) for part in parts], [part.protocol.places.num_database for part in parts])
    split, allowed = sum(sizes[: len(teach)]), sum(databases[: len(teach)])
    queries, rows = np.arange(sum(sizes)), np.arange(sum(databases))
    half = Half(queries[:split], queries[split:], rows < allowed, tuple(sizes[: len(teach)]))
    protocol = replace(
        first.protocol,
        positives=[join_positives(sets) for sets in zip(*(part.protocol.positives for part in parts), strict=True)],
        places=join_positives([part.protocol.places for part in parts]),
        halves=[half],
        split="other sets",
        reported_sets={part.name: len(part.match_set) for part in report},
    )
    width = max(part.match_set.counts.shape[1] for part in parts)

    def join(arrays: Iterable[np.ndarray], fill: Any) -> np.ndarray:
        """Arrays `[queries, candidates]`, padded to the widest, one below the other."""
        padding = lambda array: [(0, 0), (0, width - array.shape[1])]  # noqa: E731
        return np.concatenate([np.pad(array, padding(array), constant_values=fill) for array in arrays])

    listed = [part.candidates for part in parts]
    starts = zip(listed, np.cumsum([0, *databases[:-1]]), strict=True)
    indices = [np.where(each.mask, each.indices + start, -1).astype(np.int32) for each, start in starts]
    scores, mask = join([each.scores for each in listed], 0), join([each.mask for each in listed], False)
    matches = list[Matches]()
    for of_query in itertools.chain.from_iterable(part.match_set.matches for part in parts):
        of_candidates = {name: values for name, values in per_pair(of_query).items() if name.endswith("1")}
        matches.append(replace(of_query, **{name: repeat_last(each, width) for name, each in of_candidates.items()}))
    counts, capacities = join([part.match_set.counts for part in parts], 0), [part.match_set.capacity for part in parts]
    match_set = MatchSet(matches, counts, max(capacities))
    return Part(" ".join(names), protocol, match_set, Shortlist(join(indices, -1), scores, mask))
