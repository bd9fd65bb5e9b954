"""Shortlists -> matches of all their pairs: batches of queries on all devices, features read while these work."""

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np

from mfvpr.features.feature_set import FeatureSet, Slots, Staged, memory_budget
from mfvpr.matching.match_set import QueryMatches, compacted
from mfvpr.matching.matcher import Matcher, match_pairs
from mfvpr.types import Features, Matches, Shortlist, per_match
from mfvpr.utils import ragged
from mfvpr.utils.numerics import Device
from mfvpr.utils.ragged import Row
from mfvpr.utils.threads import ordered_map

QUERIES = 8  # of a batch: they share the candidates that are read for them
PAIRS = 128  # of a call

Calls = list[tuple[np.ndarray, Matches]]  # (numbers of pairs [n], Matches [P, ...] that the device computes)


class Part(NamedTuple):
    """Pairs of a batch of queries whose candidates fit on the device at the same time.

    pairs: `[n, 3]` row of the query, place of the candidate in its shortlist, row of the database.
    device: which matches them.
    ends: `[B]` rows of the queries that have no further pairs.
    """

    pairs: np.ndarray
    device: Device
    ends: np.ndarray


class Pair(NamedTuple):
    """What was matched of one pair: its real matches, and the sizes `[2]` of its images."""

    matches: Row
    image_size0: np.ndarray
    image_size1: np.ndarray


@dataclass(frozen=True)
class Sides:
    """Both sides' features on one device."""

    queries: Slots
    database: Slots

    def stage(self, part: Part) -> tuple[Staged, Staged]:
        """Read what is not there."""
        return self.queries.stage(part.pairs[:, 0]), self.database.stage(part.pairs[:, 2])

    def begin(self, staged: tuple[Staged, Staged], matcher: Matcher) -> Calls:
        """Hand a part's pairs to the device, a call for every `PAIRS` of the same capacities."""
        arrays0, arrays1 = self.queries.put(staged[0]), self.database.put(staged[1])
        capacities, slots = (
            np.stack([getattr(side, name) for side in staged], axis=1) for name in ("capacity", "slot")
        )
        calls = []
        for shape in np.unique(capacities, axis=0):
            members = np.flatnonzero((capacities == shape).all(axis=1))
            sides = arrays0[int(shape[0])], arrays1[int(shape[1])]
            for start in range(0, len(members), PAIRS):
                some = members[start : start + PAIRS]
                pairs = ragged.filled(slots[some], PAIRS)
                calls.append((some, match_pairs(*sides, pairs, np.int32(len(some)), matcher)))
        return calls


def matched(
    queries: FeatureSet,
    database: FeatureSet,
    candidates: Shortlist,
    todo: Sequence[int],
    matcher: Matcher,
    *,
    memory: float | None,
    devices: Sequence[Device],
) -> Iterator[tuple[int, QueryMatches]]:
    """(row, all of that query), in their order, NumPy.

    Args:
        queries: Q images.
        database: M images.
        candidates: `[Q, C]` rows of the database.
        todo: rows of the queries that are to be matched.
        matcher: of one pair.
        memory: GB for features of the database, see `sources.memory_budget`.
        devices: that share the queries.
    """
    indices, scores = np.asarray(candidates.indices), np.asarray(candidates.scores)
    counts0, counts1, rows = queries.counts, database.counts, np.asarray(todo, int)
    # Of all queries, though some are done: what goes on where it was must have the shapes, and the bits, of one run.
    some, budget = np.unique(indices), memory_budget(memory, devices)
    sides = {
        device: Sides(
            Slots(queries, np.arange(len(queries)), 0, device), Slots(database, some[some >= 0], budget, device)
        )
        for device in devices
    }
    nothing = _nothing(queries, database, matcher)
    pairs: dict[tuple[int, int], Pair] = {}  # by query and place, until the query's last
    begun: deque[tuple[Part, Calls]] = deque()
    parts = _parts(counts0, counts1, indices, rows, sides)
    staged = ordered_map(lambda part: (part, sides[part.device].stage(part)), parts, workers=1)
    for step in itertools.chain(staged, [None]):
        if step is not None:
            begun.append((step[0], sides[step[0].device].begin(step[1], matcher)))
        while len(begun) > (0 if step is None else len(devices)):
            part, calls = begun.popleft()
            for call in calls:
                pairs.update(_collected(part, *call))
            for query in part.ends.tolist():
                of_query = [pairs.pop((query, place), None) for place in range(indices.shape[1])]
                keypoints = np.where(indices[query] >= 0, counts1[indices[query]], 0).astype(np.int32)
                matches = _joined(of_query, nothing)
                matches = replace(matches, count0=counts0[query].astype(np.int32), count1=keypoints)
                counts = np.array([0 if pair is None else len(pair.matches["points0"]) for pair in of_query], np.int32)
                yield query, QueryMatches(matches, counts, indices[query], scores[query])


def _parts(
    counts0: np.ndarray, counts1: np.ndarray, indices: np.ndarray, todo: np.ndarray, sides: dict[Device, Sides]
) -> Iterator[Part]:
    """Batch by batch, each on the next device; without pairs that have no keypoints on one side, hence no matches."""
    for start, device in zip(range(0, len(todo), QUERIES), itertools.cycle(sides), strict=False):
        batch = todo[start : start + QUERIES]
        rows = indices[batch]
        number, place = np.nonzero((rows >= 0) & (counts1[rows] > 0) & (counts0[batch] > 0)[:, None])
        pairs = np.stack([batch[number], place, rows[number, place]], axis=1)
        together = list(sides[device].database.parts(np.unique(pairs[:, 2])))
        for some in together[:-1]:
            yield Part(pairs[np.isin(pairs[:, 2], some)], device, batch[:0])
        yield Part(pairs[np.isin(pairs[:, 2], together[-1:])], device, batch)


def _collected(part: Part, members: np.ndarray, matches: Matches) -> Iterator[tuple[tuple[int, int], Pair]]:
    """((row of the query, place of the candidate), what was matched)."""
    real = jax.tree.map(lambda values: np.asarray(values)[: len(members)], matches)
    entries = zip(part.pairs[members].tolist(), compacted(real), real.image_size0, real.image_size1, strict=True)
    for (query, place, _), row, *sizes in entries:
        yield (query, place), Pair(row, *sizes)


def _joined(pairs: Sequence[Pair | None], nothing: Row) -> Matches:
    """All candidates' matches, one after the other; an image that was not matched is of 1 x 1 px, as nobody looks."""
    some = [pair for pair in pairs if pair is not None]
    rows = ragged.joined([pair.matches for pair in some] or [nothing])
    unknown = np.ones(2, np.float32)
    return Matches(
        **rows,
        mask=np.ones(len(rows["points0"]), bool),
        image_size0=some[0].image_size0 if some else unknown,
        image_size1=np.array([unknown if pair is None else pair.image_size1 for pair in pairs]).reshape(-1, 2),
    )


def _nothing(queries: FeatureSet, database: FeatureSet, matcher: Matcher) -> Row:
    """The entries of no match, of the fields that the matcher gives."""
    known = [side.dimension for side in (queries, database) if (side.counts > 0).any()]
    dimension = known[0] if known else getattr(matcher, "dimension", 1)
    shapes = {"keypoints": (1, 2), "descriptors": (1, dimension), "scores": (1,), "image_size": (2,)}
    arrays = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
    image = Features(**arrays, mask=np.ones(1, bool))
    fields = per_match(jax.eval_shape(matcher, image, image))
    return {name: np.zeros((0, *leaf.shape[1:]), leaf.dtype) for name, leaf in fields.items()}
