"""Features of those of a map's images that were asked for last, on the device: as many as the memory allows."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Protocol

import jax
import numpy as np

from mfvpr.features.feature_set import (
    STEP,
    WRITTEN,
    Recent,
    empty_slots,
    few_sizes,
    memory_budget,
    stacked,
    write_slots,
)
from mfvpr.types import Features
from mfvpr.utils.numerics import device_of, round_up

_LEAST = 256  # slots, twice as many as a query's candidates at least


class Rows(Protocol):
    """What a map keeps on disk."""

    def counts(self, rows: Sequence[int]) -> np.ndarray:
        """`[n]` keypoints, -1 = a row is not there."""
        ...

    def features(self, rows: Sequence[int]) -> Iterator[tuple[int, Features]]:
        """(row, features)."""
        ...


class Resident:
    """Slots on the device, padded to one capacity.

    Both grow in few steps, so that a growing map costs a few programs and not one for each image.
    """

    def __init__(self, rows: Rows, *, typical: int, candidates: int, memory: float | None) -> None:
        """Nothing is there yet.

        Args:
            rows: of the map.
            typical: keypoints of an image, about; where detectors keep no more, no capacity is larger.
            candidates: of a query: so many must be there at the same time.
            memory: GB that they may take; None = a third of what is free. There are twice the candidates in any case.
        """
        self._rows, self._typical = rows, round_up(typical, STEP)
        self._least, self._device = max(_LEAST, 2 * candidates), device_of(())
        self._budget = memory_budget(memory, [self._device])  # once: slots must not change with what is free later
        self._recent, self.capacity = Recent(0), 0
        self._arrays: Features | None = None

    def hold(self, rows: Sequence[int], query: Features, total: int) -> tuple[Features, np.ndarray]:
        """(all slots `[S, N, ...]`, the slots of rows `[n]`), good until the next call.

        Args:
            rows: distinct.
            query: unpadded features, for which the capacity must do as well.
            total: rows of the map.
        """
        counts = self._rows.counts(range(total) if self._arrays is None else rows)
        arrays = self._grown(int(max(counts, default=0)), query, total)
        slots, new = self._recent.take(rows)
        place, read = dict(zip(rows, slots, strict=True)), self._rows.features(new)
        self._arrays = None  # until all is there: a slot whose row cannot be read holds another row
        while part := [*itertools.islice(read, WRITTEN)]:
            where = np.full(WRITTEN, self._recent.number, np.int32)
            where[: len(part)] = [place[row] for row, _ in part]
            images = stacked([image for _, image in part], self.capacity, total=WRITTEN)
            arrays = write_slots(arrays, where, jax.device_put(images, self._device))
        self._arrays = arrays
        return arrays, np.array(slots, np.int32)

    def _grown(self, count: int, query: Features, total: int) -> Features:
        """The slots; new ones, empty, where larger ones or more are needed."""
        count = max(count, len(query.mask), 1)
        capacity = self.capacity
        if count > capacity:
            capacity = min(size for size in (self._typical, few_sizes(round_up(count, STEP))) if size >= count)
        if self._arrays is not None and capacity == self.capacity and total <= self._recent.number:
            return self._arrays
        one = stacked([query], capacity, total=1)
        fitting = self._budget // sum(leaf.nbytes for leaf in jax.tree.leaves(one))
        number = self._least
        while number < total and 2 * number <= fitting:
            number *= 2
        if self._arrays is None or capacity > self.capacity or number > self._recent.number:
            self._recent, self.capacity = Recent(number), capacity
            self._arrays = empty_slots(jax.device_put(one, self._device), number)
        return self._arrays
