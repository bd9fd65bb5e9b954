"""Matches of many queries with their candidates, ragged; in batches of pairs for whatever scores them."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from mfvpr.types import Matches, per_match, per_pair
from mfvpr.utils import ragged
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import available_cpus, round_up
from mfvpr.utils.threads import ordered_map

BATCH_SLOTS = 2**14  # matches of a batch of pairs: its votes stay in cache
PAIRS_STEP = 8
SLOTS_STEP = 32
PROGRAM_SLOTS = 2**21  # are scored by one setting while a program for one shape more would be compiled
QUANTILES = (0.25, 0.5, 0.75, 0.95, 1.0)
BYTES_PER_SLOT = 41
BLOCK_BYTES = 2**28

Normalize = Literal["zscore", "none"]


@dataclass(frozen=True)
class QueryMatches:
    """All of one query: its candidates, and their real matches one after the other. NumPy.

    Attributes:
        matches: Matches `[n, ...]` of all candidates, best candidate first, without padding; `image_size0` `[2]` and
            `count0` `[]` are the query's, `image_size1` `[C, 2]` and `count1` `[C]` the candidates'.
        counts: `[C]` int32 matches of each candidate; their sum is n.
        indices: `[C]` int32 database rows, best first, -1 = none.
        filter_scores: `[C]` float32.
    """

    matches: Matches
    counts: np.ndarray
    indices: np.ndarray
    filter_scores: np.ndarray


@dataclass(frozen=True)
class MatchSet:
    """Matches of every query with its candidates, of one scale, without padding.

    Attributes:
        matches: per query, as in QueryMatches; those of a store may be read whenever they are asked for.
        counts: `[Q, C]` matches of each candidate.
        capacity: slots that hold every pair's matches.
    """

    matches: Sequence[Matches]
    counts: np.ndarray
    capacity: int

    @classmethod
    def of(cls, matches: Sequence[Matches], counts: np.ndarray) -> "MatchSet":
        """With a capacity that other sets of about as many matches have as well."""
        return cls(matches, counts, round_up(int(counts.max(initial=0)), 64))

    def __getitem__(self, query: int) -> Matches:
        """Matches `[C, K, ...]` of one query, padded with zeros to the capacity."""
        return self.pairs(np.full(self.counts.shape[1], query), np.arange(self.counts.shape[1]), self.capacity)

    def __len__(self) -> int:
        return len(self.matches)

    def take(self, queries: Sequence[int] | np.ndarray) -> "MatchSet":
        """Of some queries, in memory."""
        taken = ordered_map(self.matches.__getitem__, list(queries), workers=available_cpus())
        return MatchSet(list(taken), self.counts[queries], self.capacity)

    def pairs(self, queries: np.ndarray, places: np.ndarray, capacity: int, *, total: int | None = None) -> Matches:
        """Matches `[P, K, ...]` of pairs, padded with zeros.

        Args:
            queries: `[P]`.
            places: `[P]` of the candidates in their shortlists.
            capacity: K, no less than the matches of any of the pairs.
            total: so many pairs in all; those beyond have no matches, and the images of the last.
        """
        asked = {query: self.matches[query] for query in np.unique(queries).tolist()}
        pairs = [(asked[query], query, place) for query, place in zip(queries.tolist(), places.tolist(), strict=True)]
        rows = [self._row(of_query, query, place) for of_query, query, place in pairs]
        entries, mask = ragged.padded(rows, capacity, total=total)
        of_pair = {
            name: np.stack([_of_pair(of_query, name, place) for of_query, _, place in pairs])
            for name in per_pair(pairs[0][0])
        }
        if total is not None:
            of_pair = {name: ragged.filled(values, total) for name, values in of_pair.items()}
        return Matches(**entries, mask=mask, **of_pair)

    @cached_property
    def _ends(self) -> np.ndarray:
        """`[Q, C]` of each candidate's matches among its query's."""
        return np.cumsum(self.counts, axis=1)

    def _row(self, of_query: Matches, query: int, place: int) -> ragged.Row:
        """The matches of a pair, views."""
        end = self._ends[query, place]
        return {name: values[end - self.counts[query, place] : end] for name, values in per_match(of_query).items()}

    @cached_property
    def image_sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """All combinations of sizes of query and database images, `[n, 2]` each."""
        sizes = [
            [np.reshape(query.image_size0, (-1, 2)), np.reshape(query.image_size1, (-1, 2))] for query in self.matches
        ]
        sizes0, sizes1 = (np.unique(np.concatenate(side), axis=0) for side in zip(*sizes, strict=True))
        return np.repeat(sizes0, len(sizes1), 0), np.tile(sizes1, (len(sizes0), 1))


@dataclass(frozen=True)
class Scales:
    """Several Matches of every pair, such as those of patches of several sizes: a match set for each scale.

    Whatever scores a MatchSet takes it in its place: each scale is scored for itself, then they are fused over the
    candidates of a query, see `mfvpr.reranking.ranking.fuse_scales`.

    Attributes:
        match_sets: S, of the same queries and candidates.
        weights: of the scales; None = 1 each.
        normalize: what is done to the scores of a scale before.
    """

    match_sets: Sequence[MatchSet]
    weights: Sequence[float] | None = None
    normalize: Normalize = "zscore"

    def __post_init__(self) -> None:
        shapes = {match_set.counts.shape for match_set in self.match_sets}
        if len(shapes) != 1:
            raise InputError(f"scales: expected match sets of the same queries and candidates, got {sorted(shapes)}")
        if self.weights is not None and len(self.weights) != len(self.match_sets):
            raise InputError(
                f"scales: expected a weight for each of {len(self.match_sets)} scales, got {len(self.weights)}"
            )

    @property
    def image_sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """As of a MatchSet, of all scales."""
        sizes0, sizes1 = zip(*(match_set.image_sizes for match_set in self.match_sets), strict=True)
        return np.concatenate(sizes0), np.concatenate(sizes1)


def _of_pair(of_query: Matches, name: str, place: int) -> np.ndarray:
    values = getattr(of_query, name)
    return values if name.endswith("0") else values[place]


def scales(match_set: MatchSet | Scales) -> Sequence[MatchSet]:
    """The match set of each scale; of one that has none, itself."""
    return match_set.match_sets if isinstance(match_set, Scales) else [match_set]


class Batch(NamedTuple):
    """Pairs of about as many matches, which are scored in one call.

    places: `[n]` in the flattened `[queries, C]`.
    slots: of each pair, no less than its matches.
    pairs: of the call, no less than n; what is beyond has no matches.
    """

    places: np.ndarray
    slots: int
    pairs: int


def slots(match_set: MatchSet, *, settings: float = math.inf) -> np.ndarray:
    """`[Q, C]` slots of the batch that each pair belongs to: few sizes, each a shape to compile, of little padding.

    Args:
        match_set: the largest size is its capacity, which those taken from it share.
        settings: that every program scores. For few of them, or in a small set, padding costs less time than compiling
            for a shape more, and there are fewer sizes.
    """
    sizes = ragged.sizes(match_set.counts, QUANTILES, SLOTS_STEP)
    sizes[-1] = max(sizes[-1], match_set.capacity)
    sizes = ragged.worthwhile(sizes, match_set.counts, PROGRAM_SLOTS / settings)
    return ragged.fitting(sizes, match_set.counts)


def shapes(match_set: MatchSet, *, settings: float = math.inf) -> dict[int, int]:
    """Pairs of a batch by their slots; not by how many there are, so that a larger set scores them as a smaller one."""
    sizes = np.unique(slots(match_set, settings=settings)).tolist()
    return {size: round_up(BATCH_SLOTS // size, PAIRS_STEP) for size in sizes}


def partition(match_set: MatchSet, queries: range, *, settings: float = math.inf) -> list[Batch]:
    """All pairs of some queries that have matches, in batches; the first of each shape come first."""
    part = slice(queries.start, queries.stop)
    counts = match_set.counts[part].reshape(-1)
    sizes = slots(match_set, settings=settings)[part].reshape(-1)
    by_shape = []
    for size, pairs in shapes(match_set, settings=settings).items():
        places = np.flatnonzero((sizes == size) & (counts > 0))
        by_shape.append([Batch(places[start : start + pairs], size, pairs) for start in range(0, len(places), pairs)])
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(*by_shape))
    return [batch for batch in in_turn if batch is not None]


def batches(match_set: MatchSet, queries: range, *, settings: float = math.inf) -> Iterator[tuple[np.ndarray, Matches]]:
    """All pairs of some queries that have matches, those of about as many together.

    Returns:
        (places `[n]` in the flattened `[queries, C]`, Matches `[P, K, ...]` of P >= n pairs; padding has no matches),
        the first of each shape first.
    """
    part = match_set.take(queries)
    for places, size, pairs in partition(match_set, queries, settings=settings):
        query, place = np.divmod(places, match_set.counts.shape[1])
        yield places, part.pairs(query, place, size, total=pairs)


def queries_that_fit(match_set: MatchSet | Scales, num_settings: int) -> int:
    """Queries whose matches, padded, and scores by so many settings BLOCK_BYTES hold, at least one."""
    bytes_of_query = block_bytes(match_set, num_settings, 1)
    return max(1, min(len(scales(match_set)[0]), BLOCK_BYTES // max(bytes_of_query, 1)))


def block_bytes(match_set: MatchSet | Scales, num_settings: int, num_queries: int) -> int:
    """Bytes that some queries take whose scores are computed together, about: matches, scores and their rankings."""
    padded = sum(slots(scale, settings=num_settings).sum(1) for scale in scales(match_set))
    largest, num_candidates = np.sort(padded)[::-1][:num_queries].sum(), scales(match_set)[0].counts.shape[1]
    of_scores = (8 + 4 * len(scales(match_set))) * num_settings * num_queries * num_candidates
    return int(2 * BYTES_PER_SLOT * largest) + of_scores


def compacted(found: Matches) -> list[dict[str, np.ndarray]]:
    """Matches `[P, K, ...]` as rows: the real ones of each pair, by field. NumPy."""
    mask = np.asarray(found.mask)
    flat = {name: np.asarray(values)[mask] for name, values in per_match(found).items()}
    return ragged.split(flat, mask.sum(axis=1))
