"""Global descriptors without what all images of a drive share, such as the season: minus the mean, over the deviation.

The database is standardized by its own statistics. Queries are standardized by those of their drive, to which 20 images
of the database are added, because few queries alone would lose what tells them apart.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Shortlist
from mfvpr.datasets.datasets import QuerySequence
from mfvpr.datasets.positives import Positives
from mfvpr.retrieval.search import EXACT, Database, ExactSearch, Queries, WhitenedSearch

Rule = Literal["auto", "drive", "running", "database", "none"]
PRIOR = 20  # images of the database
_LEAST_VARIANCE = 1e-6  # relative to the mean of all dimensions; less is rounding, and counts as none


class Moments(NamedTuple):
    """Means of descriptors and of their squares."""

    count: float  # of images
    mean: Float[np.ndarray, " dimensions"]
    square: Float[np.ndarray, " dimensions"]

    @classmethod
    def of(cls, vectors: Float[np.ndarray, "images dimensions"]) -> "Moments | None":
        """Moments of all descriptors that are finite, float64; None without any."""
        usable = vectors[np.isfinite(vectors).all(axis=1)]
        if not len(usable):
            return None
        squares = np.einsum("nd,nd->d", usable, usable, dtype=np.float64)
        return cls(len(usable), usable.mean(axis=0, dtype=np.float64), squares / len(usable))

    def joined(self, moments: "Moments | None") -> "Moments":
        """Moments of the images of both; None = no images."""
        if moments is None:
            return self
        count = self.count + moments.count
        mean = (self.count * self.mean + moments.count * moments.mean) / count
        square = (self.count * self.square + moments.count * moments.square) / count
        return Moments(count, mean, square)

    def standardize(self, vectors: Float[np.ndarray, "images dimensions"]) -> Float[np.ndarray, "images dimensions"]:
        """Descriptors minus the mean, over the deviation, of unit length, float32; 0 without variance."""
        variance = self.square - self.mean**2
        varies = variance > _LEAST_VARIANCE * variance.mean()
        factor = np.where(varies, 1 / np.sqrt(np.where(varies, variance, 1)), 0)
        return _of_unit_length((vectors - self.mean.astype(np.float32)) * factor.astype(np.float32))

    def center(self, vectors: Float[np.ndarray, "images dimensions"]) -> Float[np.ndarray, "images dimensions"]:
        """Descriptors minus the mean, of unit length, float32."""
        return _of_unit_length(vectors - self.mean.astype(np.float32))


def _of_unit_length(vectors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(lengths > 0, lengths, 1)).astype(np.float32)


class GrowingDatabase:
    """Descriptors of a database that grows, standardized for one image at a time.

    The statistics are those of the first rows: as many as there are, rounded down to four binary digits, such as 960 of
    1,000. So they change seldom, and do not depend on when rows were added.
    """

    def __init__(self) -> None:
        self._known = dict[str, tuple[int, Moments, np.ndarray, int]]()  # by rule; the last is the number of rows

    def standardize(self, database: Database, query: Queries, drive: Moments | None) -> tuple[Queries, Database]:
        """A query `[1, D]` and the database, by the images of a `drive` so far; None = by the database's mean."""
        rule, size = "database" if drive is None else "running", len(database)
        step = 1 << max(0, size.bit_length() - 4)
        basis = size // step * step
        known = self._known.get(rule)
        if known is None or known[0] != basis:
            moments = Moments.of(database[:basis])
            if moments is None:
                return query, database
            known = basis, moments, np.empty((basis + step, database.shape[1]), np.float32), 0
        _, moments, rows, done = known
        rows[done:size] = (moments.center if drive is None else moments.standardize)(database[done:size])
        self._known[rule] = (basis, moments, rows, max(done, size))
        if drive is None:
            return moments.center(query), rows[:size]
        return moments._replace(count=PRIOR).joined(drive).standardize(query), rows[:size]


@dataclass(frozen=True)
class StandardizedSearch:
    """Exact search among standardized descriptors.

    Attributes:
        standardize: `drive` uses all queries of a drive, also those behind the query; `running` uses those up to the
            query, as a robot has to. `database` subtracts the mean of the database on both sides, for queries that are
            not a drive in order. `auto` is what `rule_of_sequence` says, or `database` where no sequence is known.
            `none` leaves descriptors as they are.
    """

    standardize: Rule = "auto"

    def fit(self, database: Database) -> "StandardizedSearch":  # `shortlist` learns the statistics
        return self

    def shortlist(
        self, queries: Queries, database: Database, num_candidates: int, *, excluded: Positives | None = None
    ) -> Shortlist:
        """Candidates of queries, which are a drive in order for `drive` and `running`; see `ExactSearch`."""
        if self.standardize != "none":
            queries, database = standardize(queries, database, self.standardize)
        return EXACT.shortlist(queries, database, num_candidates, excluded=excluded)


Search = ExactSearch | WhitenedSearch | StandardizedSearch


def rule_of_sequence(rule: Rule, sequence: QuerySequence) -> Rule:
    """The rule that `auto` stands for: `drive` where the ground truth counts frames, otherwise `database`."""
    if rule != "auto":
        return rule
    return "drive" if sequence.truth is not None and sequence.truth.unit == "frames" else "database"


def standardize(queries: Queries, database: Database, rule: Rule) -> tuple[Queries, Database]:
    """Standardize descriptors of queries and of the database, see `StandardizedSearch`."""
    of_database = Moments.of(database)
    if of_database is None:  # no image of the database is usable
        return queries, database
    if rule in ("auto", "database"):
        return of_database.center(queries), of_database.center(database)
    drive = of_database._replace(count=PRIOR)
    if rule == "drive":
        standardized = drive.joined(Moments.of(queries)).standardize(queries)
    else:
        standardized = np.empty_like(queries, np.float32)
        for row in range(len(queries)):
            drive = drive.joined(Moments.of(queries[row : row + 1]))
            standardized[row] = drive.standardize(queries[row : row + 1])[0]
    return standardized, of_database.standardize(database)
