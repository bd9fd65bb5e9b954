"""What answers are worth that come with a confidence: precision against recall, and whether p means what it says."""

from typing import NamedTuple

import numpy as np

from mfvpr.utils.errors import InputError

BINS = 10
_DRAWS = 400


class PrecisionRecall(NamedTuple):
    """What comes of answering only queries whose confidence is at least a threshold.

    thresholds: `[n]` each confidence that an answer has, descending.
    precision: `[n]` fraction of the answers that are right.
    recall: `[n]` right answers, as a fraction of the queries that have one.
    """

    thresholds: np.ndarray
    precision: np.ndarray
    recall: np.ndarray

    @property
    def average_precision(self) -> float:
        """Mean precision over the recall from 0 to 1, where that is never reached 0: sum of P_n (R_n - R_n-1)."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    def recall_at(self, precision: float) -> float:
        """The highest recall at a precision or a better one; 0 where there is none."""
        return float(np.max(self.recall, where=self.precision >= precision, initial=0.0))


class Reliability(NamedTuple):
    """Answers in bins of the same width of their probabilities, from 0 to 1.

    probability: `[bins]` mean, NaN where there are no answers.
    right: `[bins]` fraction of right ones, likewise.
    count: `[bins]` of answers.
    """

    probability: np.ndarray
    right: np.ndarray
    count: np.ndarray

    @property
    def calibration_error(self) -> float:
        """Mean distance of both over all answers (expected calibration error); NaN without any."""
        if not self.count.any():
            return float("nan")
        return float(np.nansum(self.count * np.abs(self.probability - self.right)) / self.count.sum())


def precision_recall(
    confidence: np.ndarray, right: np.ndarray, has_answer: np.ndarray | None = None
) -> PrecisionRecall:
    """Precision and recall of first answers at every threshold.

    Args:
        confidence: `[Q]` any number that is larger for surer answers; NaN where there is no answer.
        right: `[Q]` bool, of the first answers.
        has_answer: `[Q]` bool, queries that have a right answer in the database; None = all. The others, whose place
            the database does not show, are negatives: an answer to them costs precision.

    Raises:
        InputError: a right answer to a query that has none.
    """
    confidence, right = np.asarray(confidence, np.float64), np.asarray(right, bool)
    has_answer = np.ones(len(right), bool) if has_answer is None else np.asarray(has_answer, bool)
    if np.any(right & ~has_answer):
        raise InputError("right: expected no right answers to queries that have none; take both of the same truth")
    order = np.argsort(-confidence, kind="stable")[: np.sum(~np.isnan(confidence))]
    thresholds, hits = confidence[order], np.cumsum(right[order])
    ends = np.append(thresholds[1:] != thresholds[:-1], [True] * min(len(thresholds), 1))
    last = np.flatnonzero(ends)  # equal confidences, infinite ones as well, are answered together
    hits = hits[last]
    return PrecisionRecall(thresholds[last], hits / (last + 1), hits / max(has_answer.sum(), 1))


def reliability(probability: np.ndarray, right: np.ndarray, *, bins: int = BINS) -> Reliability:
    """How often answers `[Q]` of a probability are right; those with NaN are left out."""
    probability, right = np.asarray(probability, np.float64), np.asarray(right, bool)
    there = ~np.isnan(probability)
    probability, right = probability[there], right[there]
    place = np.clip((probability * bins).astype(int), 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    divisor = np.where(count > 0, count, np.nan)
    mean, share = (np.bincount(place, weights=one, minlength=bins) / divisor for one in (probability, right))
    return Reliability(mean, share, count)


def chance_calibration_error(probability: np.ndarray, *, bins: int = BINS, seed: int = 0) -> float:
    """The `calibration_error` that perfectly calibrated probabilities `[Q]` have on average, by so few queries."""
    probability = np.asarray(probability, np.float64)
    rng = np.random.default_rng(seed)
    draws = (rng.random(len(probability)) < probability for _ in range(_DRAWS))
    return float(np.mean([reliability(probability, right, bins=bins).calibration_error for right in draws]))
