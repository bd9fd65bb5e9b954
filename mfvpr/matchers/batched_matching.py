"""Shortlists -> matches of all pairs, in batches of queries on all devices."""

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int, Num

from mfvpr.core.types import Features, Matches, Shortlist, per_match
from mfvpr.features.feature_set import FeatureSet, Slots, Staged, memory_budget
from mfvpr.matchers.match_set import QueryMatches, Row, split_pairs
from mfvpr.matchers.matcher import Matcher, match_pairs
from mfvpr.utils.numerics import Device, holds_function, repeat_last
from mfvpr.utils.runtime import ordered_map

QUERIES = 8  # per batch; the queries of a batch share the features of their candidates
PAIRS = 128  # per call

Calls = list[tuple[Int[np.ndarray, " pairs"], Matches]]  # (positions in the pairs of a part, their matches)


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
    counts0: Int[np.ndarray, " queries"],
    counts1: Int[np.ndarray, " database"],
    indices: Int[np.ndarray, "queries candidates"],
    todo: Int[np.ndarray, " rows"],
    sides: dict[Device, Sides],
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
