"""Shortlists -> matches of all pairs, in batches of queries on all devices; ragged sets; padded batches for scoring."""

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, Num

from mfvpr.core.types import Features, Matches, Shortlist, per_match, per_pair
from mfvpr.features.feature_set import FeatureSet, Slots, Staged, few_capacities, memory_budget, pad_rows
from mfvpr.matchers.matcher import Matcher, match_pairs
from mfvpr.utils.fingerprints import content_hash
from mfvpr.utils.numerics import Device, available_cpus, holds_function, repeat_last, round_up
from mfvpr.utils.runtime import ordered_map

QUERIES = 8  # per batch; the queries of a batch share the features of their candidates
PAIRS = 128  # per call
BATCH_SLOTS = 2**14  # slots of a batch of pairs: its votes stay in the cache
PAIRS_STEP = 8
SLOTS_STEP = 32
PROGRAM_SLOTS = 2**21  # slots that one setting scores in the time that another shape takes to compile
QUANTILES = (0.25, 0.5, 0.75, 0.95, 1.0)
BYTES_PER_SLOT = 41
BLOCK_BYTES = 2**28

Row = Mapping[str, np.ndarray]  # matches [n, ...] by field
Calls = list[tuple[Int[np.ndarray, " pairs"], Matches]]  # (positions in the pairs of a part, their matches)


@dataclass(frozen=True)
class QueryMatches:
    """Candidates of one query, best first, and their n real matches one after the other. NumPy."""

    matches: Matches  # image_size0 [2] and count0 [] are the query's, image_size1 [C, 2] and count1 [C] the candidates'
    counts: Int[np.ndarray, " candidates"]  # matches of each candidate, int32; their sum is n
    indices: Int[np.ndarray, " candidates"]  # database rows, int32, -1 = none
    filter_scores: Float[np.ndarray, " candidates"]  # float32


@dataclass(frozen=True)
class MatchSet:
    """Matches of every query with its candidates, of one scale, without padding."""

    matches: Sequence[Matches]  # per query, as in QueryMatches; a store may read them on access
    counts: Int[np.ndarray, "queries candidates"]  # matches of each candidate
    capacity: int  # slots that suffice for every pair

    @classmethod
    def of(cls, matches: Sequence[Matches], counts: Int[np.ndarray, "queries candidates"]) -> "MatchSet":
        """Match set with a rounded capacity, so that sets of similar size share programs."""
        return cls(matches, counts, round_up(int(counts.max(initial=0)), 64))

    def __getitem__(self, query: int) -> Matches:
        """Matches `[C, K, ...]` of one query, padded with zeros to the capacity."""
        places = np.arange(self.counts.shape[1])
        return self.pairs(np.full_like(places, query), places, self.capacity)

    def __len__(self) -> int:
        return len(self.matches)

    def take(self, queries: Sequence[int] | np.ndarray) -> "MatchSet":
        """Match set of the given queries, in memory."""
        matches = ordered_map(self.matches.__getitem__, list(queries), workers=available_cpus())
        return MatchSet(list(matches), self.counts[queries], self.capacity)

    def pairs(self, queries: np.ndarray, places: np.ndarray, capacity: int, *, total: int | None = None) -> Matches:
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
    """Matches of every pair at several scales, such as patch sizes.

    Functions that score a MatchSet accept Scales, too, and fuse the scores of the scales, see `fuse_scales`.
    """

    match_sets: Sequence[MatchSet]  # one per scale, of the same queries and candidates
    weights: Sequence[float] | None = None  # of the scales; None = 1 each

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


def prune_capacities(capacities: np.ndarray, counts: Int[np.ndarray, "..."], saving: float) -> Int[np.ndarray, " _"]:
    """The largest of ascending `capacities`, and each that saves at least `saving` slots of padding."""
    lengths = counts[counts > 0]
    while len(capacities) > 1:
        rows = np.bincount(np.searchsorted(capacities, lengths), minlength=len(capacities))
        saved = rows[:-1] * np.diff(capacities)
        if saved.min() >= saving:
            break
        capacities = np.delete(capacities, saved.argmin())
    return capacities


class Part(NamedTuple):
    """Pairs of a batch of queries with candidates that fit on the device at the same time."""

    pairs: Int[np.ndarray, "pairs 3"]  # row of the query, position of the candidate in its shortlist, database row
    device: Device
    ends: Int[np.ndarray, " queries"]  # rows of the queries without further pairs


class Pair(NamedTuple):
    """Real matches of one pair, and the sizes of its images."""

    matches: Row
    image_size0: Num[np.ndarray, "2"]
    image_size1: Num[np.ndarray, "2"]


Sides = tuple[Slots, Slots]  # features of queries and of the database on one device


def match_queries(
    queries: FeatureSet,
    database: FeatureSet,
    candidates: Shortlist,
    todo: Sequence[int],
    matcher: Matcher,
    *,
    memory: float | None,
    devices: Sequence[Device],
) -> Iterator[tuple[int, QueryMatches]]:
    """Match queries with their candidates: (row, matches) in the order of `todo`, NumPy.

    A thread reads features while the devices work. `memory` is `mfvpr.Runtime.memory`.
    """
    indices, scores = np.asarray(candidates.indices), np.asarray(candidates.scores)
    counts0, counts1, rows = queries.counts, database.counts, np.asarray(todo, int)
    match = partial(match_pairs, matcher=matcher)
    if holds_function(matcher):  # or it would be compiled for every call; the program goes with the last query
        match = jax.jit(match)
    database_rows, budget = np.unique(indices), memory_budget(memory, devices)
    database_rows = database_rows[database_rows >= 0]
    sides = {
        device: (Slots(queries, np.arange(len(queries)), 0, device), Slots(database, database_rows, budget, device))
        for device in devices
    }

    def stage(part: Part) -> tuple[Part, list[Staged]]:
        """Read the features that are not on the device."""
        return part, [slots.stage(part.pairs[:, side]) for slots, side in zip(sides[part.device], (0, 2), strict=True)]

    no_matches = _no_matches(queries, database, matcher)
    pairs: dict[tuple[int, int], Pair] = {}  # by (query, place), until the last pair of the query
    begun: deque[tuple[Part, Calls]] = deque()
    parts = _parts(counts0, counts1, indices, rows, sides)
    for step in itertools.chain(ordered_map(stage, parts, workers=1), [None]):
        if step is not None:
            begun.append((step[0], _begin(sides[step[0].device], step[1], match)))
        while len(begun) > (0 if step is None else len(devices)):
            part, calls = begun.popleft()
            for positions, padded in calls:
                count = len(positions)
                real = jax.tree.map(lambda values, count=count: np.asarray(values)[:count], padded)
                places = map(tuple, part.pairs[positions, :2].tolist())
                of_call = map(Pair, split_pairs(real), real.image_size0, real.image_size1)
                pairs.update(zip(places, of_call, strict=True))
            for query in part.ends.tolist():
                of_query = [pairs.pop((query, place), None) for place in range(indices.shape[1])]
                keypoints = np.where(indices[query] >= 0, counts1[indices[query]], 0).astype(np.int32)
                matches, counts = join_candidates(of_query, no_matches, counts0[query].astype(np.int32), keypoints)
                yield query, QueryMatches(matches, counts, indices[query], scores[query])


def _parts(
    counts0: np.ndarray, counts1: np.ndarray, indices: np.ndarray, todo: np.ndarray, sides: dict[Device, Sides]
) -> Iterator[Part]:
    """Parts of all batches, each batch on the next device; without pairs that lack keypoints."""
    for start, device in zip(range(0, len(todo), QUERIES), itertools.cycle(sides), strict=False):
        batch = todo[start : start + QUERIES]
        rows = indices[batch]
        number, place = np.nonzero((rows >= 0) & (counts1[rows] > 0) & (counts0[batch] > 0)[:, None])
        pairs = np.stack([batch[number], place, rows[number, place]], axis=1)
        groups = list(sides[device][1].parts(np.unique(pairs[:, 2])))  # database rows that fit at the same time
        for group in groups[:-1]:
            yield Part(pairs[np.isin(pairs[:, 2], group)], device, batch[:0])
        yield Part(pairs[np.isin(pairs[:, 2], groups[-1:])], device, batch)


def _begin(sides: Sides, staged: Sequence[Staged], match: Callable[..., Matches]) -> Calls:
    """Start matching a part on the device, a call per `PAIRS` pairs of the same capacities."""
    arrays = [slots.put(rows) for slots, rows in zip(sides, staged, strict=True)]
    capacities, slots = (np.stack([getattr(side, name) for side in staged], axis=1) for name in ("capacity", "slot"))
    calls = []
    for shape in np.unique(capacities, axis=0):
        members = np.flatnonzero((capacities == shape).all(axis=1))
        features = [of_side[int(capacity)] for of_side, capacity in zip(arrays, shape, strict=True)]
        for start in range(0, len(members), PAIRS):
            positions = members[start : start + PAIRS]
            pairs = repeat_last(slots[positions], PAIRS)
            calls.append((positions, match(*features, pairs, np.int32(len(positions)))))
    return calls


def join_candidates(
    pairs: Sequence[Pair | None], no_matches: Row, count0: Any, count1: Int[np.ndarray, " candidates"] | None
) -> tuple[Matches, Int[np.ndarray, " candidates"]]:
    """Matches of all candidates, one after the other, and their numbers; images without a pair have 1 x 1 px."""
    missing = Pair(no_matches, np.ones(2, np.float32), np.ones(2, np.float32))
    real = [pair for pair in pairs if pair is not None] or [missing]
    rows = {name: np.concatenate([pair.matches[name] for pair in real]) for name in real[0].matches}
    pairs = [pair or missing for pair in pairs]
    matches = Matches(
        **rows,
        mask=np.ones(len(rows["points0"]), bool),
        image_size0=real[0].image_size0,
        image_size1=np.array([pair.image_size1 for pair in pairs]).reshape(-1, 2),
        count0=count0,
        count1=count1,
    )
    return matches, np.array([len(pair.matches["points0"]) for pair in pairs], np.int32)


def _no_matches(queries: FeatureSet, database: FeatureSet, matcher: Matcher) -> Row:
    """Empty row with the fields that the matcher returns."""
    dimensions = [side.dimension for side in (queries, database) if (side.counts > 0).any()]
    dimension = dimensions[0] if dimensions else getattr(matcher, "dimension", 1)
    shapes = {"keypoints": (1, 2), "descriptors": (1, dimension), "scores": (1,), "image_size": (2,)}
    arrays = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
    image = Features(**arrays, mask=np.ones(1, bool))
    fields = per_match(jax.eval_shape(matcher, image, image))
    return {name: np.zeros((0, *leaf.shape[1:]), leaf.dtype) for name, leaf in fields.items()}
