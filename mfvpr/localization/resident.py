"""Features of the recently used images of a map, in the memory of the host: as many as fit."""

from collections import OrderedDict
from collections.abc import Sequence

import jax

from mfvpr.core.types import Features
from mfvpr.features.feature_set import SHARE
from mfvpr.storage.maps import MapRows
from mfvpr.utils.numerics import free_host_bytes


class Resident:
    """Features of rows; the least recently used ones make room."""

    def __init__(self, rows: MapRows, memory: float | None) -> None:
        """Read nothing yet; `memory` is in GB, None = a third of the free memory."""
        self._rows, self._free = rows, SHARE * free_host_bytes() if memory is None else 1e9 * memory
        self._features: OrderedDict[int, Features] = OrderedDict()

    def read(self, rows: Sequence[int]) -> list[Features]:
        """Features `[n, ...]` of distinct rows, in their order, NumPy, without padding."""
        for row, features in self._rows.features([row for row in rows if row not in self._features]):
            self._features[row] = features
            self._free -= _bytes(features)
        for row in rows:
            self._features.move_to_end(row)
        read = [self._features[row] for row in rows]
        while self._free < 0:
            self._free += _bytes(self._features.popitem(last=False)[1])
        return read


def _bytes(features: Features) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(features))
