"""Shortlists -> matches of all their pairs: batches of queries on all devices, features read while these work."""

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from mfvpr import ragged
from mfvpr.data.images import ordered_map
from mfvpr.match_sets import QueryMatches, compacted
from mfvpr.matching import match_pairs
from mfvpr.numerics import Device
from mfvpr.ragged import Row
from mfvpr.sources import FeatureSet, Slots, Staged, memory_budget
from mfvpr.types import Matches, Shortlist

QUERIES = 8  # of a batch: they share the candidates that are read for them
PAIRS = 128  # of a call

Calls = list[tuple[np.ndarray, Matches]]  # (numbers of pairs [n], Matches [P, ...] that the device computes)


class Part(NamedTuple):
    """Pairs of a batch of queries whose candidates fit on the device at the same time.

    pairs: `[n, 3]` row of the query, place of the candidate in its shortlist, row of the database.
    rows: `[r]` distinct rows of the database.
    device: which has it.
    ends: `[B]` rows of the queries that have no further pairs.
    """

    pairs: np.ndarray
    rows: np.ndarray
    device: Device
    ends: np.ndarray


@dataclass(frozen=True)
class Sides:
    """Both sides' features on one device."""

    queries: Slots
    database: Slots

    def stage(self, part: Part) -> tuple[Staged, Staged]:
        """Read what is not there."""
        return self.queries.stage(np.unique(part.pairs[:, 0])), self.database.stage(part.rows)

    def begin(self, part: Part, staged: tuple[Staged, Staged], **options: Any) -> Calls:
        """Hand a part's pairs to the device, a call for every `PAIRS` of the same capacities."""
        arrays0, arrays1 = self.queries.put(staged[0]), self.database.put(staged[1])
        where0, where1 = (
            np.searchsorted(np.unique(part.pairs[:, 0]), part.pairs[:, 0]),
            np.searchsorted(part.rows, part.pairs[:, 2]),
        )
        capacities = np.stack([staged[0].capacity[where0], staged[1].capacity[where1]], axis=1)
        slots = np.stack([staged[0].slot[where0], staged[1].slot[where1]], axis=1)
        calls = []
        for shape in np.unique(capacities, axis=0):
            members = np.flatnonzero((capacities == shape).all(axis=1))
            for start in range(0, len(members), PAIRS):
                some = members[start : start + PAIRS]
                pairs = ragged.filled(slots[some], PAIRS)
                sides = arrays0[int(shape[0])], arrays1[int(shape[1])]
                calls.append((some, match_pairs(*sides, pairs, np.int32(len(some)), **options)))
        return calls


def matched(
    queries: FeatureSet,
    database: FeatureSet,
    candidates: Shortlist,
    todo: Sequence[int],
    *,
    memory: float | None,
    devices: Sequence[Device],
    with_ratio: bool,
    **options: Any,
) -> Iterator[tuple[int, QueryMatches]]:
    """(row, all of that query), in their order, NumPy.

    Args:
        queries: Q images.
        database: M images.
        candidates: `[Q, C]` rows of the database.
        todo: rows of the queries that are to be matched.
        memory: GB for features of the database, see `sources.memory_budget`.
        devices: that share the queries.
        with_ratio: see `match_pairs`.
        **options: likewise.
    """
    indices, scores = np.asarray(candidates.indices), np.asarray(candidates.scores)
    counts0, counts1, rows = queries.counts, database.counts, np.asarray(todo, int)
    pairs = _pairs(counts0, counts1, indices, rows)
    wanted0, wanted1 = (np.unique(pairs[:, column]) for column in (0, 2))
    sides = {
        device: Sides(
            Slots(queries, wanted0, 0, device), Slots(database, wanted1, memory_budget(memory, device), device)
        )
        for device in devices
    }
    entries: dict[tuple[int, int], Row] = {}
    begun: deque[tuple[Part, Calls]] = deque()
    staged = ordered_map(lambda part: (part, sides[part.device].stage(part)), _parts(pairs, rows, sides), workers=1)
    for step in itertools.chain(staged, [None]):
        if step is not None:
            begun.append((step[0], sides[step[0].device].begin(*step, with_ratio=with_ratio, **options)))
        while len(begun) > (0 if step is None else len(devices)):
            part, calls = begun.popleft()
            entries |= {pair: row for call in calls for pair, row in _collected(part, *call)}
            for query in part.ends.tolist():
                found = [entries.pop((query, place), None) for place in range(indices.shape[1])]
                of_pair = _of_pair(found, int(counts0[query]), counts1, indices[query])
                flat = _joined(found, with_ratio)
                counts = np.array([0 if row is None else len(row["distance"]) for row in found], np.int32)
                matches = Matches(**flat, **of_pair, mask=np.ones(counts.sum(), bool))
                yield query, QueryMatches(matches, counts, indices[query], scores[query])


def _pairs(counts0: np.ndarray, counts1: np.ndarray, indices: np.ndarray, todo: np.ndarray) -> np.ndarray:
    """`[n, 3]` of `Part`, query by query; without those that have no keypoints on one side, hence no matches."""
    rows = indices[todo]
    number, place = np.nonzero((rows >= 0) & (counts1[rows] > 0) & (counts0[todo] > 0)[:, None])
    return np.stack([todo[number], place, rows[number, place]], axis=1)


def _parts(pairs: np.ndarray, todo: np.ndarray, sides: dict[Device, Sides]) -> Iterator[Part]:
    """Batch by batch, each on the next device."""
    for start, device in zip(range(0, len(todo), QUERIES), itertools.cycle(sides), strict=False):
        batch = todo[start : start + QUERIES]
        some = pairs[np.isin(pairs[:, 0], batch)]
        pieces = list(sides[device].database.parts(np.unique(some[:, 2]))) or [np.zeros(0, int)]
        for number, rows in enumerate(pieces):
            ends = batch if number == len(pieces) - 1 else batch[:0]
            yield Part(some[np.isin(some[:, 2], rows)], rows, device, ends)


def _collected(part: Part, members: np.ndarray, matches: Matches) -> Iterator[tuple[tuple[int, int], Row]]:
    """((row of the query, place of the candidate), the real matches)."""
    rows = compacted(jax.tree.map(lambda values: np.asarray(values)[: len(members)], matches))
    sizes = (np.asarray(matches.image_size0), np.asarray(matches.image_size1))
    for number, (member, row) in enumerate(zip(members.tolist(), rows, strict=True)):
        query, place, _ = part.pairs[member].tolist()
        yield (query, place), row | {"image_size0": sizes[0][number], "image_size1": sizes[1][number]}


def _of_pair(found: Sequence[Row | None], count0: int, counts1: np.ndarray, indices: np.ndarray) -> Row:
    """Sizes and counts of the images; one that was not matched is of 1 x 1 px, which nobody looks at."""
    nobody = np.ones(2, np.float32)
    return {
        "image_size0": next((row["image_size0"] for row in found if row is not None), nobody),
        "image_size1": np.stack([nobody if row is None else row["image_size1"] for row in found]),
        "count0": np.array(count0, np.int32),
        "count1": np.where(indices >= 0, counts1[indices], 0).astype(np.int32),
    }


def _joined(found: Sequence[Row | None], with_ratio: bool) -> Row:
    """All candidates' matches, one after the other."""
    rows = [{name: values for name, values in row.items() if "size" not in name} for row in found if row is not None]
    return ragged.joined(rows or [_nothing(with_ratio)])


def _nothing(with_ratio: bool) -> Row:
    """The entries of no match."""
    points, numbers, rows = np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32)
    ratio = {"ratio": numbers} if with_ratio else {}
    scalars = {"distance": numbers, "scores0": numbers, "scores1": numbers}
    return {"points0": points, "points1": points, "index0": rows, "index1": rows} | scalars | ratio
