"""Features of the recently used images of a map, on the device: as many as the memory allows."""

import itertools
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Int

from mfvpr.features.feature_set import (
    STEP,
    WRITTEN,
    Recent,
    empty_slots,
    few_sizes,
    memory_budget,
    stack_features,
    write_slots,
)
from mfvpr.storage.maps import MapRows
from mfvpr.types import Features
from mfvpr.utils.numerics import device_of, round_up

_LEAST = 256  # slots, twice as many as a query's candidates at least


class Resident:
    """Slots of one capacity on the device; both numbers grow in few steps, so that few programs are compiled."""

    def __init__(self, rows: MapRows, *, typical: int, candidates: int, memory: float | None) -> None:
        """Read nothing yet; there will be at least two slots for each of a query's candidates.

        `typical` is the usual number of keypoints of an image, or the detector's limit; `memory` is in GB.
        """
        self._rows, self._typical = rows, round_up(typical, STEP)
        self._least, self._device = max(_LEAST, 2 * candidates), device_of(())
        self._budget = memory_budget(memory, [self._device])  # once: slots must not change with what is free later
        self._recent, self.capacity = Recent(0), 0
        self._arrays: Features | None = None

    def hold(self, rows: Sequence[int], query: Features, total: int) -> tuple[Features, Int[np.ndarray, " rows"]]:
        """Put distinct rows on the device; return all slots `[S, N, ...]` and those of the rows, until the next call.

        The unpadded features of the `query` must fit into the capacity as well; `total` is the number of rows.
        """
        counts = self._rows.counts(range(total) if self._arrays is None else rows)
        arrays = self._grow(int(max(counts, default=0)), query, total)
        slots, new = self._recent.take(rows)
        slot_of, read = dict(zip(rows, slots, strict=True)), self._rows.features(new)
        self._arrays = None  # until all rows are read: a slot whose row cannot be read holds another row
        while batch := [*itertools.islice(read, WRITTEN)]:
            targets = np.full(WRITTEN, self._recent.number, np.int32)
            targets[: len(batch)] = [slot_of[row] for row, _ in batch]
            images = stack_features([image for _, image in batch], self.capacity, total=WRITTEN)
            arrays = write_slots(arrays, targets, jax.device_put(images, self._device))
        self._arrays = arrays
        return arrays, np.array(slots, np.int32)

    def _grow(self, count: int, query: Features, total: int) -> Features:
        """The slots, or new, empty ones if a larger capacity or more slots are needed."""
        count = max(count, len(query.mask), 1)
        capacity = self.capacity
        if count > capacity:
            capacity = min(size for size in (self._typical, few_sizes(round_up(count, STEP))) if size >= count)
        if self._arrays is not None and capacity == self.capacity and total <= self._recent.number:
            return self._arrays
        slot = stack_features([query], capacity, total=1)
        fitting = self._budget // sum(leaf.nbytes for leaf in jax.tree.leaves(slot))
        number = self._least
        while number < total and 2 * number <= fitting:
            number *= 2
        if self._arrays is None or capacity > self.capacity or number > self._recent.number:
            self._recent, self.capacity = Recent(number), capacity
            self._arrays = empty_slots(jax.device_put(slot, self._device), number)
        return self._arrays
