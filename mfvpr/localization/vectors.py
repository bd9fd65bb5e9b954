"""Global descriptors of a map in memory, and the rows that are most similar to a query."""

from functools import partial

import numpy as np
from jaxtyping import Float, Int

from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.threads import ordered_map

_FIRST = 1024  # rows; twice as many whenever they are full


class Vectors:
    """Global descriptors by row."""

    def __init__(self) -> None:
        self._values, self._is_candidate = np.zeros((0, 0), np.float32), np.zeros(0, bool)
        self._total = 0  # rows that are used

    @property
    def length(self) -> int | None:
        """D; None = there is no descriptor yet."""
        return self._values.shape[1] if self._values.size else None

    def __getitem__(self, row: int) -> Float[np.ndarray, " dimensions"]:
        """The descriptor of a row."""
        return self._values[row]

    def append(self, vector: Float[np.ndarray, " dimensions"]) -> None:
        """Store the descriptor of the next row."""
        if self._total == len(self._values):
            more = np.zeros((max(_FIRST, self._total), len(vector)), np.float32)
            self._values = np.concatenate([self._values.reshape(-1, len(vector)), more])
            self._is_candidate = np.concatenate([self._is_candidate, np.zeros(len(more), bool)])
        self._values[self._total] = vector
        # An image without features has a zero descriptor and is never a candidate, as in `mfvpr.retrieval.Retrieval`.
        self._is_candidate[self._total] = bool(np.isfinite(vector).all() and vector.any())
        self._total += 1

    def nearest(
        self, query: Float[np.ndarray, " dimensions"], number: int, *, before: int | None = None
    ) -> tuple[Int[np.ndarray, " candidates"], Float[np.ndarray, " candidates"]]:
        """At most `number` rows `before` a row, and their products with the query, most similar first, then by row."""
        total = self._total if before is None else max(0, min(self._total, before))
        rows = np.flatnonzero(self._is_candidate[:total])
        if not len(rows) or not query.any():
            return rows[:0], np.zeros(0, np.float32)
        # Own threads: those of BLAS spin while they wait, which costs a third of the time.
        workers = available_cpus()
        parts = np.array_split(self._values[:total], workers)
        products = np.concatenate([*ordered_map(partial(np.vecdot, query), parts, workers=workers)])
        if len(rows) > number:
            least = np.partition(products[rows], -number)[-number]
            rows = rows[products[rows] >= least]
        best = rows[np.argsort(-products[rows], kind="stable")][:number]
        return best, products[best]
