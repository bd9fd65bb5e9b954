"""Confidences of predictions: precision against recall, and calibration."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mfvpr.utils.errors import InputError

BINS = 10


class PrecisionRecall(NamedTuple):
    """Precision and recall if only queries with a confidence of at least a threshold have a prediction."""

    thresholds: Float[np.ndarray, " thresholds"]  # the distinct confidences of the predictions, descending
    precision: Float[np.ndarray, " thresholds"]  # fraction of the predictions that are correct
    recall: Float[np.ndarray, " thresholds"]  # correct predictions, as a fraction of the queries with positives

    @property
    def average_precision(self) -> float:
        """Sum of P_n (R_n - R_n-1): the mean precision over recalls from 0 to 1, 0 for recalls that are not reached."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    def recall_at(self, precision: float) -> float:
        """The highest recall with at least a precision; 0 if there is none."""
        return float(np.max(self.recall, where=self.precision >= precision, initial=0.0))


class Reliability(NamedTuple):
    """Predictions in bins of equal width of their probabilities, from 0 to 1."""

    probability: Float[np.ndarray, " bins"]  # mean, NaN in an empty bin
    correct: Float[np.ndarray, " bins"]  # fraction of correct predictions, NaN in an empty bin
    count: Int[np.ndarray, " bins"]  # of predictions

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean of |probability - fraction of correct ones| over all predictions, or NaN."""
        if not self.count.any():
            return float("nan")
        return float(np.nansum(self.count * np.abs(self.probability - self.correct)) / self.count.sum())


def precision_recall(
    confidence: Float[np.ndarray, " queries"],
    correct: Bool[np.ndarray, " queries"],
    has_positives: Bool[np.ndarray, " queries"] | None = None,
) -> PrecisionRecall:
    """Precision and recall of top predictions at every threshold.

    Args:
        confidence: any number that is larger for more confident predictions; NaN without a prediction.
        correct: whether the top prediction is correct.
        has_positives: queries with positives in the database; None = all. A prediction for another query is incorrect
            and lowers the precision.

    Raises:
        InputError: a correct prediction for a query without positives.
    """
    confidence, correct = np.asarray(confidence, np.float64), np.asarray(correct, bool)
    has_positives = np.ones(len(correct), bool) if has_positives is None else np.asarray(has_positives, bool)
    if np.any(correct & ~has_positives):
        raise InputError(
            "correct: expected no correct predictions for queries without positives. Take both from one ground truth."
        )
    order = np.argsort(-confidence, kind="stable")[: np.sum(~np.isnan(confidence))]
    thresholds, hits = confidence[order], np.cumsum(correct[order])
    # Equal confidences, also infinite ones, share a threshold.
    last = np.flatnonzero(np.append(thresholds[1:] != thresholds[:-1], [True] * min(len(thresholds), 1)))
    return PrecisionRecall(thresholds[last], hits[last] / (last + 1), hits[last] / max(has_positives.sum(), 1))


def reliability(
    probability: Float[np.ndarray, " queries"], correct: Bool[np.ndarray, " queries"], *, bins: int = BINS
) -> Reliability:
    """Compare probabilities with the fractions of correct predictions; NaN probabilities are left out."""
    there = ~np.isnan(probability)
    probability, correct = probability[there], np.asarray(correct, bool)[there]
    place = _bin_numbers(probability, bins)
    count = np.bincount(place, minlength=bins)
    divisor = np.where(count > 0, count, np.nan)
    mean, share = (np.bincount(place, weights=values, minlength=bins) / divisor for values in (probability, correct))
    return Reliability(mean, share, count)


def chance_calibration_error(probability: Float[np.ndarray, " queries"]) -> float:
    """Expected `calibration_error` of perfectly calibrated probabilities, which is above 0 for few queries; exact."""
    probability = probability[~np.isnan(probability)]
    if not len(probability):
        return float("nan")
    place, distance = _bin_numbers(probability, BINS), 0.0
    for number in range(BINS):
        inside, chances = probability[place == number], np.ones(1)  # of 0 ... correct predictions in the bin
        for value in inside:
            chances = np.convolve(chances, (1 - value, value))
        distance += chances @ np.abs(np.arange(len(chances)) - inside.sum())
    return float(distance / len(probability))


def _bin_numbers(probability: np.ndarray, bins: int) -> np.ndarray:
    return np.clip((probability * bins).astype(int), 0, bins - 1)
