"""The interface of ground truth: positives at a threshold."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from mfvpr.datasets.positives import Positives

Unit = Literal["frames", "m", "exact"]
TOLERANCES = (1, 2, 5)  # frames
RADIUS = 25.0  # meters


class Truth(ABC):
    """The correct database images of each query."""

    @property
    @abstractmethod
    def unit(self) -> Unit:
        """Unit of thresholds; "exact" = thresholds do not matter."""

    @abstractmethod
    def positives(self, threshold: float) -> Positives:
        """Correct database images at a threshold, inclusive."""

    def shows_place(self, threshold: float) -> Positives:
        """Database images of the query's place, including images that are excluded from its candidates."""
        return self.positives(threshold)

    @abstractmethod
    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        """Distance of each database image to the query's place, in the unit; infinite = never correct."""

    def place(self, query: int) -> int | None:
        """The database row nearest to the query's place; None if the place is unknown."""
        distance = self.distance(query)
        nearest = int(np.argmin(distance)) if distance.size else None
        return nearest if nearest is not None and np.isfinite(distance[nearest]) else None

    def thresholds(self, *, tolerances: Iterable[int] = TOLERANCES, radius: float = RADIUS) -> list[float]:
        """Thresholds in the unit, ascending: tolerances in frames, the radius in meters, or 0 if exact."""
        return {"frames": sorted(set(tolerances)), "m": [radius], "exact": [0]}[self.unit]


def middle(thresholds: Sequence[float]) -> float:
    """The main threshold, for predictions, failures, figures and confidence; at least one is required."""
    return thresholds[len(thresholds) // 2]


def threshold_words(unit: Unit, threshold: float) -> str:
    """Text of a threshold behind R@K in tables, for example " ±2"."""
    return {"frames": f" ±{threshold:g}", "m": f" {threshold:g} m", "exact": ""}[unit]
