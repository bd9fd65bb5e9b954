"""Quality of confidences: precision against recall, and calibration."""

from typing import NamedTuple

import numpy as np

from mfvpr.utils.errors import InputError

BINS = 10
_DRAWS = 400


class PrecisionRecall(NamedTuple):
    """Precision and recall if only queries with a confidence of at least a threshold have a prediction.

    thresholds: `[n]` the distinct confidences of the predictions, descending.
    precision: `[n]` fraction of the predictions that are correct.
    recall: `[n]` correct predictions, as a fraction of the queries with positives.
    """

    thresholds: np.ndarray
    precision: np.ndarray
    recall: np.ndarray

    @property
    def average_precision(self) -> float:
        """Sum of P_n (R_n - R_n-1): the mean precision over recalls from 0 to 1, 0 for recalls that are not reached."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    def recall_at(self, precision: float) -> float:
        """The highest recall with at least a precision; 0 if there is none."""
        return float(np.max(self.recall, where=self.precision >= precision, initial=0.0))


class Reliability(NamedTuple):
    """Predictions in bins of equal width of their probabilities, from 0 to 1.

    probability: `[bins]` mean, NaN in an empty bin.
    right: `[bins]` fraction of correct predictions, NaN in an empty bin.
    count: `[bins]` of predictions.
    """

    probability: np.ndarray
    right: np.ndarray
    count: np.ndarray

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean of |probability - fraction of correct ones| over all predictions, or NaN."""
        if not self.count.any():
            return float("nan")
        return float(np.nansum(self.count * np.abs(self.probability - self.right)) / self.count.sum())


def precision_recall(
    confidence: np.ndarray, right: np.ndarray, has_answer: np.ndarray | None = None
) -> PrecisionRecall:
    """Precision and recall of top predictions at every threshold.

    Args:
        confidence: `[Q]` any number that is larger for more confident predictions; NaN without a prediction.
        right: `[Q]` bool, whether the top prediction is correct.
        has_answer: `[Q]` bool, queries with positives in the database; None = all. A prediction for another query is
            incorrect and lowers the precision.

    Raises:
        InputError: a correct prediction for a query without positives.
    """
    confidence, right = np.asarray(confidence, np.float64), np.asarray(right, bool)
    has_answer = np.ones(len(right), bool) if has_answer is None else np.asarray(has_answer, bool)
    if np.any(right & ~has_answer):
        raise InputError("right: expected no correct predictions for queries without positives. Take both from one "
                         "ground truth.")  # fmt: skip
    order = np.argsort(-confidence, kind="stable")[: np.sum(~np.isnan(confidence))]
    thresholds, hits = confidence[order], np.cumsum(right[order])
    ends = np.append(thresholds[1:] != thresholds[:-1], [True] * min(len(thresholds), 1))
    last = np.flatnonzero(ends)  # equal confidences, also infinite ones, share a threshold
    hits = hits[last]
    return PrecisionRecall(thresholds[last], hits / (last + 1), hits / max(has_answer.sum(), 1))


def reliability(probability: np.ndarray, right: np.ndarray, *, bins: int = BINS) -> Reliability:
    """Compare probabilities `[Q]` with the fractions of correct predictions; NaN probabilities are left out."""
    probability, right = np.asarray(probability, np.float64), np.asarray(right, bool)
    there = ~np.isnan(probability)
    probability, right = probability[there], right[there]
    place = np.clip((probability * bins).astype(int), 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    divisor = np.where(count > 0, count, np.nan)
    mean, share = (np.bincount(place, weights=values, minlength=bins) / divisor for values in (probability, right))
    return Reliability(mean, share, count)


def chance_calibration_error(probability: np.ndarray, *, bins: int = BINS, seed: int = 0) -> float:
    """Mean `calibration_error` of perfectly calibrated probabilities `[Q]`, which is above 0 for few queries."""
    probability = np.asarray(probability, np.float64)
    rng = np.random.default_rng(seed)
    draws = (rng.random(len(probability)) < probability for _ in range(_DRAWS))
    return float(np.mean([reliability(probability, right, bins=bins).calibration_error for right in draws]))
