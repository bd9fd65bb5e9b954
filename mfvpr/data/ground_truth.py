"""Where each query really is: by file order, UTM coordinates in the file names, or what `truth_files` reads.

Truth comes in three kinds. Two have a threshold that decides what still counts: frames of the database sequence, or a
radius in meters. The third is exact: a database image is right or it is not.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import ClassVar, Literal

import numpy as np

from mfvpr.errors import InputError
from mfvpr.evaluation import radius_positives

KINDS = {
    "order": "query i shows database image i",
    "index": "a file of pairs",
    "utm": "positions in the names, @easting@northing@...",
    "label": "two csv files of name,label: the same label (floor, room) is right",
    "none": "rankings only",
}
CHOICES = "; ".join(f"{kind} ({meaning})" for kind, meaning in KINDS.items())
FARTHEST = 1e9  # meters; beyond, distances lose their centimeters, and at last their meaning
Unit = Literal["frames", "m", "exact"]


class Truth(ABC):
    """Which database images are right for each query."""

    @property
    @abstractmethod
    def unit(self) -> Unit:
        """Of thresholds; "exact" = they do not matter."""

    @abstractmethod
    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool, what counts as right at a threshold, inclusive."""

    def shows_place(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool, database images of the query's place, also those that may not answer it."""
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


def threshold_words(unit: Unit, threshold: float) -> str:
    """What stands behind R@K in a table."""
    return {"frames": f" ±{threshold:g}", "m": f" {threshold:g} m", "exact": ""}[unit]


@dataclass(frozen=True)
class FrameTruth(Truth):
    """The database rows that show each query's place; neighbors within a tolerance in frames count as well.

    Attributes:
        rows: per query; empty = unknown place, which counts as a failure.
        num_database: N.
        widened: False = no neighbors count, at any tolerance.
    """

    rows: tuple[tuple[int, ...], ...]
    num_database: int
    widened: bool = True

    @property
    def unit(self) -> Unit:
        """Frames, where there are tolerances."""
        return "frames" if self.widened else "exact"

    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool for a tolerance in frames, inclusive."""
        tolerance = int(threshold) if self.widened else 0
        positives = np.zeros((len(self.rows), self.num_database), bool)
        for right, rows in zip(positives, self.rows, strict=True):
            for row in rows:
                right[max(row - tolerance, 0) : row + tolerance + 1] = True
        return positives

    def distance(self, query: int) -> np.ndarray:
        """`[N]` frames to the nearest of the query's rows."""
        distance = np.full(self.num_database, np.inf)
        for row in self.rows[query]:
            distance = np.minimum(distance, np.abs(np.arange(self.num_database) - row))
        return distance if self.widened else np.where(distance > 0, np.inf, 0.0)


@dataclass(frozen=True)
class RadiusTruth(Truth):
    """Positions in meters; database images within a radius of the query count."""

    unit: ClassVar[Unit] = "m"
    query_xy: np.ndarray  # [Q, 2]
    database_xy: np.ndarray  # [N, 2]

    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool for a radius in meters, inclusive."""
        return radius_positives(self.query_xy, self.database_xy, radius=threshold)

    def distance(self, query: int) -> np.ndarray:
        """`[N]` meters."""
        return np.linalg.norm(self.database_xy - self.query_xy[query], axis=1)


@dataclass(frozen=True)
class LabelTruth(Truth):
    """Labels, of floors or rooms, as numbers; database images of the query's label are right. -1 = no label."""

    unit: ClassVar[Unit] = "exact"
    query_labels: np.ndarray  # [Q]
    database_labels: np.ndarray  # [N]

    def positives(self, threshold: float = 0) -> np.ndarray:
        """`[Q, N]` bool, at any threshold."""
        return (self.query_labels[:, None] == self.database_labels) & (self.query_labels >= 0)[:, None]

    def distance(self, query: int) -> np.ndarray:
        """`[N]` 0 or infinite."""
        label = self.query_labels[query]
        return np.where((self.database_labels == label) & (label >= 0), 0.0, np.inf)


@dataclass(frozen=True)
class AllowedTruth(Truth):
    """Another truth, of which some database images are no answer to some queries."""

    truth: Truth
    allowed: np.ndarray  # [Q, N] bool

    @property
    def unit(self) -> Unit:
        """The other's."""
        return self.truth.unit

    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool, the other's that are allowed."""
        return self.truth.positives(threshold) & self.allowed

    def shows_place(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool, the other's, and what is not allowed: the query itself, and its neighbors."""
        return self.truth.shows_place(threshold) | ~self.allowed

    def distance(self, query: int) -> np.ndarray:
        """`[N]` the other's; infinite where an image is not allowed."""
        return np.where(self.allowed[query], self.truth.distance(query), np.inf)


def truth_by_order(num_queries: int, num_database: int) -> FrameTruth:
    """Query i shows database image i, in file order."""
    if num_queries != num_database:
        raise InputError(
            f"ground_truth=order: expected as many queries as database images, got {num_queries} and {num_database}; "
            "name the pairs in an index file, or use another ground truth"
        )
    return FrameTruth(tuple((row,) for row in range(num_queries)), num_database)


def truth_from_names(query_names: Sequence[str], database_names: Sequence[str]) -> RadiusTruth:
    """UTM easting and northing from names `@easting@northing@...` (the convention of VPR-datasets-downloader)."""
    return RadiusTruth(
        np.array([_position(name) for name in query_names]), np.array([_position(name) for name in database_names])
    )


def _position(name: str) -> tuple[float, float]:
    """Easting, northing of one name; folders above the file may contain '@' as well."""
    fields = PurePosixPath(name).name.split("@")
    try:
        easting, northing = float(fields[1]), float(fields[2])
    except (IndexError, ValueError):
        raise InputError(
            f"{name}: expected a name like @easting@northing@...; or choose another ground truth"
        ) from None
    if not (abs(easting) <= FARTHEST and abs(northing) <= FARTHEST):  # NaN neither
        raise InputError(
            f"{name}: expected easting and northing of at most {FARTHEST:g} m, got {easting:g} and {northing:g}"
        )
    return easting, northing
