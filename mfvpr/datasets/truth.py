"""What evaluation asks of a ground truth: positives at a threshold."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np

from mfvpr.datasets.positives import Positives

Unit = Literal["frames", "m", "exact"]


class Truth(ABC):
    """Which database images are right for each query."""

    @property
    @abstractmethod
    def unit(self) -> Unit:
        """Of thresholds; "exact" = they do not matter."""

    @abstractmethod
    def positives(self, threshold: float) -> Positives:
        """What counts as right at a threshold, inclusive."""

    def shows_place(self, threshold: float) -> Positives:
        """Database images of the query's place, also those that may not answer it."""
        return self.positives(threshold)

    @abstractmethod
    def distance(self, query: int) -> np.ndarray:
        """`[N]` from each database image to the query's place, in the unit; infinite where it is never right."""

    def place(self, query: int) -> int | None:
        """The database row that shows the query's place best, None if there is none."""
        distance = self.distance(query)
        best = int(np.argmin(distance)) if distance.size else None
        return best if best is not None and np.isfinite(distance[best]) else None

    def thresholds(self, *, tolerances: Iterable[int], radius: float) -> list[float]:
        """Those of the unit, ascending: tolerances in frames, or the radius in meters; 0 alone where truth is exact."""
        return {"frames": sorted(set(tolerances)), "m": [radius], "exact": [0]}[self.unit]


def middle(thresholds: Sequence[float]) -> float:
    """The threshold that predictions, failures, figures and confidence go by, of at least one."""
    return thresholds[len(thresholds) // 2]


def threshold_words(unit: Unit, threshold: float) -> str:
    """What stands behind R@K in a table."""
    return {"frames": f" ±{threshold:g}", "m": f" {threshold:g} m", "exact": ""}[unit]
