"""Frame correlation of SSM-VPR (Camara & Preucil, RAS 2020): the next query is likely near the previous places."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mfvpr.reranking.ranking import Scores
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class FrameCorrelation:
    """Increase the scores of candidates near the places of the previous queries.

    The place of a query is its best candidate. A candidate d database rows from the place of a previous query gains
    strength * gain * (1 - d / reach) of its score; the largest gain over the previous queries counts. The strength is
    the score of that place over the best score of the previous places, and 1 if `previous` is 1 or all scores are 0.
    Queries and database images must be in the order of the drive.

    The public code differs in two details: it rounds the scores of places to two digits, and it assigns row 0 to a
    query without a score above 0, which has no place here.

    Attributes:
        previous: number of previous queries, from 1; the first `previous` queries keep their scores.
        reach: database rows.
        gain: largest relative increase of a score.
    """

    previous: int = 2
    reach: float = 15.0
    gain: float = 0.4

    def __post_init__(self) -> None:
        if self.previous < 1 or not 0 < self.reach < np.inf or not 0 <= self.gain < np.inf:
            raise InputError(f"FrameCorrelation(previous={self.previous}, reach={self.reach}, gain={self.gain}): "
                             "expected at least one query, a finite reach above 0, a finite gain from 0")  # fmt: skip

    def __call__(self, candidates: Shortlist, scores: Scores) -> Scores:
        """Correlated scores of a sequence, float32.

        Scores that are not above 0, and NaN, stay the same. Among equal scores the lowest row is the query's place.
        """
        mask, correlated = np.asarray(candidates.mask), np.array(scores, np.float64)
        before: deque[tuple[float, float]] = deque(maxlen=self.previous)  # (row, score) of the last places
        for row_scores, rows, usable in zip(correlated, np.asarray(candidates.indices, float), mask, strict=True):
            positive = usable & (row_scores > 0)
            if len(before) == self.previous:
                row_scores[positive] *= 1 + self._gains(rows[positive], np.array(before))
            best = row_scores.max(where=positive, initial=0)
            before.append((rows.min(where=positive & (row_scores == best), initial=np.inf), best))
        return correlated.astype(np.float32)

    def _gains(self, rows: np.ndarray, before: Float[np.ndarray, "previous 2"]) -> np.ndarray:
        """Largest relative gains of rows; `before` are places and scores."""
        places, scores = before.T
        best = scores.max()
        strength = scores / best if best > 0 and self.previous > 1 else np.ones(len(scores))
        nearness = np.maximum(1 - np.abs(rows[:, None] - places) / self.reach, 0)
        return self.gain * np.max(strength * nearness, axis=1, initial=0)
