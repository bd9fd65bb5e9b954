"""Frame correlation of SSM-VPR (Camara & Preucil, RAS 2020): the next query is likely near the places of the last."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class FrameCorrelation:
    """Scores grow by a share of themselves near the places where the queries before were.

    A candidate d rows of the database from where one of them was gains strength * gain * (1 - d / reach) of its score,
    the most that any of them gives. The strength is the score of that query's place by the best of theirs; it is 1 of
    a single one, or where all are 0. Queries and database images must be in the order of the drive.

    As in the public code, but that this rounds the scores of places to two digits, and puts a query of which nothing
    scores above 0 at row 0, where it is nowhere here.

    Attributes:
        previous: queries that are looked back at, from 1; those before the first so many are scored as they are.
        reach: rows of the database.
        gain: the most that a score grows by, in shares of itself.
    """

    previous: int = 2
    reach: float = 15.0
    gain: float = 0.4

    def __post_init__(self) -> None:
        if self.previous < 1 or not 0 < self.reach < np.inf or not 0 <= self.gain < np.inf:
            raise InputError(f"FrameCorrelation(previous={self.previous}, reach={self.reach}, gain={self.gain}): "
                             "expected at least one query, a finite reach above 0, a finite gain from 0")  # fmt: skip

    def __call__(self, candidates: Shortlist, scores: np.ndarray) -> np.ndarray:
        """Scores `[Q, C]` of a sequence's candidates, NumPy float32, out of those of each query by itself.

        Those that are not above 0, NaN too, stay what they are. Of equal scores the lowest row is the query's place.
        """
        mask, correlated = np.asarray(candidates.mask), np.array(scores, np.float64)
        before: deque[tuple[float, float]] = deque(maxlen=self.previous)  # (row, score) of the last places
        for of_query, rows, usable in zip(correlated, np.asarray(candidates.indices, float), mask, strict=True):
            some = usable & (of_query > 0)
            if len(before) == self.previous:
                of_query[some] *= 1 + self._gains(rows[some], np.array(before))
            best = of_query.max(where=some, initial=0)
            before.append((rows.min(where=some & (of_query == best), initial=np.inf), best))
        return correlated.astype(np.float32)

    def _gains(self, rows: np.ndarray, before: np.ndarray) -> np.ndarray:
        """`[n]` of candidates' rows, the most that places and scores `[previous, 2]` give."""
        places, scores = before.T
        best = scores.max()
        strength = scores / best if best > 0 and self.previous > 1 else np.ones(len(scores))
        nearness = np.maximum(1 - np.abs(rows[:, None] - places) / self.reach, 0)
        return self.gain * np.max(strength * nearness, axis=1, initial=0)
