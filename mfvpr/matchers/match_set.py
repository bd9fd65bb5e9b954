"""Matches of many queries with their candidates: ragged sets, and padded batches of pairs for scoring."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Num

from mfvpr.core.types import Matches, per_match, per_pair
from mfvpr.features.feature_set import few_capacities, pad_rows
from mfvpr.utils.fingerprints import content_hash
from mfvpr.utils.numerics import available_cpus, repeat_last, round_up
from mfvpr.utils.runtime import ordered_map

BATCH_SLOTS = 2**14  # slots of a batch of pairs: its votes stay in the cache
PAIRS_STEP = 8
SLOTS_STEP = 32
PROGRAM_SLOTS = 2**21  # slots that one setting scores in the time that another shape takes to compile
QUANTILES = (0.25, 0.5, 0.75, 0.95, 1.0)
BYTES_PER_SLOT = 41
BLOCK_BYTES = 2**28

Row = Mapping[str, np.ndarray]  # matches [n, ...] by field


@dataclass(frozen=True)
class QueryMatches:
    """Candidates of one query, best first, and their n real matches one after the other. NumPy.

    In the matches, `image_size0` `[2]` and `count0` `[]` are the query's, `image_size1` `[C, 2]` and `count1` `[C]` the
    candidates'.
    """

    matches: Matches
    counts: Int[np.ndarray, " candidates"]  # matches of each candidate, int32; their sum is n
    indices: Int[np.ndarray, " candidates"]  # database rows, int32, -1 = none
    filter_scores: Float[np.ndarray, " candidates"]  # float32


@dataclass(frozen=True)
class MatchSet:
    """Matches of every query with its candidates, of one scale, without padding.

    Attributes:
        matches: per query, as in QueryMatches; a store may read them on access.
        counts: matches of each candidate.
        capacity: slots that suffice for every pair.
    """

    matches: Sequence[Matches]
    counts: Int[np.ndarray, "queries candidates"]
    capacity: int

    @classmethod
    def of(cls, matches: Sequence[Matches], counts: Int[np.ndarray, "queries candidates"]) -> "MatchSet":
        """Match set with a rounded capacity, so that sets of similar size share programs."""
        return cls(matches, counts, round_up(int(counts.max(initial=0)), 64))

    def __getitem__(self, query: int) -> Matches:
        """Matches `[C, K, ...]` of one query, padded with zeros to the capacity."""
        return self.pairs(np.full(self.counts.shape[1], query), np.arange(self.counts.shape[1]), self.capacity)

    def __len__(self) -> int:
        return len(self.matches)

    def take(self, queries: Sequence[int] | np.ndarray) -> "MatchSet":
        """Match set of the given queries, in memory."""
        matches = ordered_map(self.matches.__getitem__, list(queries), workers=available_cpus())
        return MatchSet(list(matches), self.counts[queries], self.capacity)

    def pairs(
        self,
        queries: Int[np.ndarray, " pairs"],
        places: Int[np.ndarray, " pairs"],
        capacity: int,
        *,
        total: int | None = None,
    ) -> Matches:
        """Matches `[P, K, ...]` of pairs, padded with zeros to K = `capacity` slots, for `places` in the shortlists.

        There are `total` pairs with padding, which has no matches, and the images of the last pair.
        """
        by_query = {query: self.matches[query] for query in np.unique(queries).tolist()}
        pairs = list(zip(queries.tolist(), places.tolist(), strict=True))
        ends = {query: np.cumsum(self.counts[query]) for query in by_query}
        rows = []
        for query, place in pairs:  # views
            part = slice(ends[query][place] - self.counts[query, place], ends[query][place])
            rows.append({name: values[part] for name, values in per_match(by_query[query]).items()})
        entries, mask = pad_rows(rows, capacity, total=total)
        for name in per_pair(by_query[pairs[0][0]]):
            values = [getattr(by_query[query], name) for query, _ in pairs]
            if name.endswith("1"):  # of all candidates
                values = [of_query[place] for of_query, (_, place) in zip(values, pairs, strict=True)]
            entries[name] = repeat_last(np.stack(values), len(mask))
        return Matches(**entries, mask=mask)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of all matches."""
        return content_hash(self.counts, [content_hash(query) for query in self.matches])

    @cached_property
    def image_sizes(self) -> tuple[Num[np.ndarray, "pairs 2"], Num[np.ndarray, "pairs 2"]]:
        """Sizes of query and database images, in all combinations."""
        sizes = [[np.reshape(size, (-1, 2)) for size in (each.image_size0, each.image_size1)] for each in self.matches]
        sizes0, sizes1 = (np.unique(np.concatenate(side), axis=0) for side in zip(*sizes, strict=True))
        return np.repeat(sizes0, len(sizes1), 0), np.tile(sizes1, (len(sizes0), 1))


@dataclass(frozen=True)
class Scales:
    """Matches of every pair at several scales, such as patch sizes: one match set per scale.

    Functions that score a MatchSet accept Scales, too, and fuse the scores of the scales, see `fuse_scales`.

    Attributes:
        match_sets: S match sets of the same queries and candidates.
        weights: of the scales; None = 1 each.
    """

    match_sets: Sequence[MatchSet]
    weights: Sequence[float] | None = None

    @property
    def image_sizes(self) -> tuple[Num[np.ndarray, "pairs 2"], Num[np.ndarray, "pairs 2"]]:
        """Image sizes of all scales, see `MatchSet.image_sizes`."""
        sizes0, sizes1 = zip(*(match_set.image_sizes for match_set in self.match_sets), strict=True)
        return np.concatenate(sizes0), np.concatenate(sizes1)


def scales(match_set: MatchSet | Scales) -> Sequence[MatchSet]:
    """The match set of each scale; a MatchSet is a single scale."""
    return match_set.match_sets if isinstance(match_set, Scales) else [match_set]


def slots(match_set: MatchSet, *, settings: float = math.inf) -> Int[np.ndarray, "queries candidates"]:
    """Slots of the batch of each pair: few sizes to compile, with little padding.

    Few settings or a small set have fewer sizes: padding then costs less time than compiling for another size.
    """
    sizes = few_capacities(match_set.counts, QUANTILES, SLOTS_STEP)
    sizes[-1] = max(sizes[-1], match_set.capacity)
    sizes = prune_capacities(sizes, match_set.counts, PROGRAM_SLOTS / settings)
    return sizes[np.searchsorted(sizes, match_set.counts)]


def shapes(match_set: MatchSet, *, settings: float = math.inf) -> dict[int, int]:
    """Pairs per batch, by slots, for any number of pairs."""
    sizes = np.unique(slots(match_set, settings=settings)).tolist()
    return {size: round_up(BATCH_SLOTS // size, PAIRS_STEP) for size in sizes}


def partition(
    match_set: MatchSet, queries: range, *, settings: float = math.inf
) -> list[tuple[Int[np.ndarray, " _"], int, int]]:
    """Batches of all pairs with matches: positions in the flattened `[queries, candidates]`, slots, pairs with padding.

    The first batch of each shape comes first.
    """
    part = slice(queries.start, queries.stop)
    counts = match_set.counts[part].reshape(-1)
    sizes = slots(match_set, settings=settings)[part].reshape(-1)
    by_shape = []
    for size, pairs in shapes(match_set, settings=settings).items():
        places = np.flatnonzero((sizes == size) & (counts > 0))
        by_shape.append([(places[start : start + pairs], size, pairs) for start in range(0, len(places), pairs)])
    interleaved = itertools.chain.from_iterable(itertools.zip_longest(*by_shape))
    return [batch for batch in interleaved if batch is not None]


def batches(
    match_set: MatchSet, queries: range, *, settings: float = math.inf
) -> Iterator[tuple[Int[np.ndarray, " pairs"], Matches]]:
    """Padded Matches `[P, K, ...]` of all batches of `partition`, with their places `[n]`, n <= P."""
    part = match_set.take(queries)
    for places, size, pairs in partition(match_set, queries, settings=settings):
        query, place = np.divmod(places, match_set.counts.shape[1])
        yield places, part.pairs(query, place, size, total=pairs)


def queries_that_fit(match_set: MatchSet | Scales, num_settings: int) -> int:
    """Number of queries, at least 1, with matches, scores and rankings that fit into about BLOCK_BYTES."""
    sets = scales(match_set)
    num_queries, num_candidates = sets[0].counts.shape
    padded = sum(slots(scale, settings=num_settings).sum(1) for scale in sets)
    of_query = 2 * BYTES_PER_SLOT * np.max(padded, initial=0) + (8 + 4 * len(sets)) * num_settings * num_candidates
    return max(1, min(num_queries, BLOCK_BYTES // max(int(of_query), 1)))


def split_pairs(matches: Matches) -> list[dict[str, np.ndarray]]:
    """Real matches of each of the pairs `[P, K, ...]`, by field. NumPy."""
    mask = np.asarray(matches.mask)
    flat = {name: np.asarray(values)[mask] for name, values in per_match(matches).items()}
    return split_rows(flat, mask.sum(axis=1))


def split_rows(flat: Row, counts: Int[np.ndarray, " rows"]) -> list[dict[str, np.ndarray]]:
    """Rows of lengths `counts`, as views of arrays that hold one row after the other."""
    ends = np.cumsum(counts)
    return [
        {name: values[end - count : end] for name, values in flat.items()}
        for count, end in zip(counts.tolist(), ends.tolist(), strict=True)
    ]


def prune_capacities(
    capacities: Int[np.ndarray, " capacities"], counts: Int[np.ndarray, "..."], saving: float
) -> Int[np.ndarray, " _"]:
    """The largest of ascending `capacities`, and each that saves at least `saving` slots of padding."""
    lengths = counts[counts > 0]
    while len(capacities) > 1:
        rows = np.bincount(np.searchsorted(capacities, lengths), minlength=len(capacities))
        saved = rows[:-1] * np.diff(capacities)
        if saved.min() >= saving:
            break
        capacities = np.delete(capacities, saved.argmin())
    return capacities
