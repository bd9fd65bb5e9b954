"""Confidence: the probability that the top prediction is correct, from how its score stands out among the others.

A model is fitted on predictions that are known to be correct or incorrect. Differences are in units of the spread of a
query's scores, so that it can be used for other images. Precision, recall and reliability say what it is worth.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Bool, Float, Int

from mfvpr.evaluation.rankings import Ranked
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, require_replaceable, write_text

APART = 5  # rows of the database
REFUSALS = 0.2, 0.5  # shares of images without enough evidence, by default
_LEAST_WEIGHT = 1e-9  # of an input: smaller ones are rounding errors, which would order equal predictions
_FORMAT = "mfvpr confidence 3"
_LEAST_SPREAD = 1e-3  # of the first score: less is rounding
_PRIOR = 2  # added candidates of other places, with the variance of all candidates
BINS = 10  # of probabilities from 0 to 1


def confidence_inputs(ranked: Ranked) -> Float[np.ndarray, "queries 2"]:
    """Margin and height, the inputs of the confidence in the top predictions; NaN without a prediction.

    margin: log(1 + x), where x is the difference of the first score and that of the best candidate of another place,
        divided by the standard deviation of the scores of candidates of other places. If there are few of them, that is
        drawn towards the standard deviation of all candidates; if there are none, the input is infinite.
    height: the same, with the mean score of candidates of other places instead of the best.

    Database images within 5 rows of the prediction count as its place.
    """
    there = (ranked.rows >= 0) & np.isfinite(ranked.scores)
    scores = np.where(there, ranked.scores, 0.0).astype(np.float64)
    elsewhere = there & (np.abs(ranked.rows - ranked.rows[:, :1]) > APART)

    def moments(where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Number, mean and variance of each query's scores; 0 if there are none."""
        count = where.sum(axis=1)
        mean = np.sum(scores, axis=1, where=where) / np.maximum(count, 1)
        squares = np.sum((scores - mean[:, None]) ** 2, axis=1, where=where)
        return count, mean, squares / np.maximum(count, 1)

    (count, mean, variance), (_, _, prior) = moments(elsewhere), moments(there)
    spread = np.sqrt((count * variance + _PRIOR * prior) / (count + _PRIOR))
    spread = np.maximum(spread, np.maximum(_LEAST_SPREAD * np.abs(scores[:, 0]), np.finfo(np.float64).tiny))
    second = np.max(scores, axis=1, where=elsewhere, initial=-np.inf)
    above = np.maximum(scores[:, :1] - np.stack([second, mean], axis=1), 0)
    inputs = np.where(elsewhere.any(axis=1, keepdims=True), np.log1p(above / spread[:, None]), np.inf)
    return np.where(there[:, :1], inputs, np.nan)


@dataclass(frozen=True)
class Confidence:
    """A logistic model of the probability that a system's top prediction is correct."""

    center: tuple[float, ...]  # mean of each input over the data that the model was fitted on
    scale: tuple[float, ...]  # standard deviation of each input over these data
    weights: tuple[float, ...]  # of the inputs in these units
    bias: float  # log odds at the center
    # Shares of images without enough evidence (`mfvpr.evaluation.evidence`), of places that the database shows and not.
    refusals: tuple[float, float] = REFUSALS
    standardize: str | None = None  # rule of the retrieval that chose the candidates; None = any

    def __call__(self, ranked: Ranked) -> Float[np.ndarray, " queries"]:
        """Probabilities, NaN without a prediction."""
        return self.probability(confidence_inputs(ranked))

    def probability(self, inputs: Float[np.ndarray, "queries inputs"]) -> Float[np.ndarray, " queries"]:
        """Probabilities from inputs; an infinite input counts as its center."""
        centered = (np.where(np.isinf(inputs), self.center, inputs) - self.center) / np.array(self.scale)
        return scipy.special.expit(centered @ np.array(self.weights) + self.bias)


def fit_confidence(values: Float[np.ndarray, "queries inputs"], correct: Bool[np.ndarray, " queries"]) -> Confidence:
    """Fit a logistic model with weights of at least 0 by penalized maximum likelihood; InputError without predictions.

    Rows of `values` (`confidence_inputs`) that are not finite are left out. For queries without a place in the database
    no prediction is `correct`. Half a correct and half an incorrect prediction are added at the center, so that the
    probability stays below 1.
    """
    there = np.isfinite(values).all(axis=1)
    values, correct = values[there], np.asarray(correct, bool)[there]
    if not len(values):
        raise InputError("confidence: expected predictions to fit it on, with candidates of other places, got none")
    center, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    columns = np.column_stack([np.ones(len(values)), (values - center) / scale])
    penalty = np.array([0.0, *[1.0] * values.shape[1]])
    bounds = [(None, None), *[(0.0, None)] * values.shape[1]]

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds, bias = columns @ weights, weights[0]
        value = np.logaddexp(0, odds).sum() - odds[correct].sum() + penalty @ weights**2 / 2
        gradient = columns.T @ (scipy.special.expit(odds) - correct) + penalty * weights
        gradient[0] += scipy.special.expit(bias) - 0.5
        return value + np.logaddexp(0, bias) - bias / 2, gradient

    options = {"ftol": 1e-13, "gtol": 1e-8, "maxiter": 1000}
    fit = scipy.optimize.minimize(loss, 0 * penalty, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    bias, *weights = np.where(np.abs(fit.x) > _LEAST_WEIGHT, fit.x, 0.0).tolist()
    return Confidence(tuple(center.tolist()), tuple(scale.tolist()), tuple(weights), bias)


def write_confidences(path: Path | str, systems: Mapping[str, Confidence], recipe: Mapping[str, Any]) -> None:
    """Write confidences by name as JSON, with the recipe of their rankings; an InputError for another file."""
    require_replaceable(Path(path), _FORMAT.encode())
    content = {"format": _FORMAT, "made": recipe, "systems": {name: vars(each) for name, each in systems.items()}}
    write_text(Path(path), json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_confidences(path: Path | str) -> tuple[dict[str, Confidence], dict[str, Any]]:
    """Read the file of `write_confidences`: confidences by name of the system, and the recipe."""
    path, expected = Path(path), "the confidence.json that an evaluation wrote"
    require_file(path, expected)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r}")
        return {name: confidence_from_json(each) for name, each in content["systems"].items()}, dict(content["made"])
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: expected {expected} ({reason}); evaluate with ground truth to make one") from error


def confidence_from_json(values: Mapping[str, Any]) -> Confidence:
    """The confidence whose `vars` were written as JSON; a TypeError or ValueError for values that make no model."""
    vectors = {name: tuple(values[name]) for name in ("center", "scale", "weights", "refusals")}
    numbers = np.array([*vectors.values()], float).reshape(4, 2)  # two inputs, two shares
    _, scale, weights, shares = numbers
    is_known = values.get("apart", APART) == APART and np.isfinite([*numbers.flat, values["bias"]]).all()
    if not (is_known and min(*scale, *shares) > 0 and min(weights) >= 0 and max(shares) <= 1):
        raise InputError("confidence: expected a model of this version, got other values; calibrate again")
    return Confidence(bias=values["bias"], **vectors, standardize=values.get("standardize"))


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
        errors = self.count * np.abs(self.probability - self.correct)
        return float(np.nansum(errors) / self.count.sum()) if self.count.any() else float("nan")


def precision_recall(
    confidence: Float[np.ndarray, " queries"],
    correct: Bool[np.ndarray, " queries"],
    has_positives: Bool[np.ndarray, " queries"] | None = None,
) -> PrecisionRecall:
    """Precision and recall of top predictions at every threshold of a confidence; NaN without a prediction.

    Queries without positives in the database have no correct prediction, else an InputError; `has_positives` None = all
    have some.
    """
    confidence, correct = np.asarray(confidence, float), np.asarray(correct, bool)
    if has_positives is not None and np.any(correct & ~np.asarray(has_positives, bool)):
        raise InputError("correct: expected no correct predictions for queries without positives")
    num_positive = len(correct) if has_positives is None else np.sum(has_positives)
    order = np.argsort(-confidence, kind="stable")[: np.sum(~np.isnan(confidence))]
    thresholds, hits = confidence[order], np.cumsum(correct[order])
    # Equal confidences, also infinite ones, share a threshold.
    last = np.flatnonzero(np.append(thresholds[1:] != thresholds[:-1], [True] * min(len(thresholds), 1)))
    return PrecisionRecall(thresholds[last], hits[last] / (last + 1), hits[last] / max(num_positive, 1))


def reliability(probability: Float[np.ndarray, " queries"], correct: Bool[np.ndarray, " queries"]) -> Reliability:
    """Compare probabilities with the fractions of correct predictions, in 10 bins; NaN probabilities are left out."""
    there = ~np.isnan(probability)
    probability, correct = probability[there], correct[there]
    place = np.minimum((probability * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    divisor = np.where(count > 0, count, np.nan)
    mean, share = (np.bincount(place, weights=values, minlength=BINS) / divisor for values in (probability, correct))
    return Reliability(mean, share, count)


def chance_calibration_error(probability: Float[np.ndarray, " queries"]) -> float:
    """Expected `calibration_error` of perfectly calibrated probabilities, which is above 0 for few queries; exact."""
    probability = probability[~np.isnan(probability)]
    if not len(probability):
        return float("nan")
    place, distance = np.minimum((probability * BINS).astype(int), BINS - 1), 0.0
    for number in range(BINS):
        inside, chances = probability[place == number], np.ones(1)  # of 0 ... correct predictions in the bin
        for value in inside:
            chances = np.convolve(chances, (1 - value, value))
        distance += chances @ np.abs(np.arange(len(chances)) - inside.sum())
    return float(distance / len(probability))
