"""Confidences fitted on predictions that are known to be correct or incorrect, and their files."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Bool, Float, Int

from mfvpr.datasets.ground_truth import Truth
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.confidence import APART, INPUTS, REFUSALS, Confidence, Input, confidence_inputs
from mfvpr.evaluation.rankings import Ranked
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, require_replaceable, write_text

__all__ = [
    "CalibrationData", "Confidence", "absent_rankings", "calibration_data", "confidence_inputs", "fit_confidence",
    "read_confidences", "write_confidences",
]  # fmt: skip

AROUND = 5  # times the distance of a correct prediction: nearer images show the place, or are not known to be elsewhere
_LEAST_WEIGHT = 1e-9  # of an input: less is a rest of the optimization, which would order equal predictions by rounding
_FORMAT = "mfvpr confidence 2"


def fit_confidence(
    values: Float[np.ndarray, "queries inputs"], correct: Bool[np.ndarray, " queries"], *,
    inputs: Sequence[Input] = INPUTS, apart: int = APART,
) -> Confidence:  # fmt: skip
    """Fit a logistic model with weights of at least 0 by penalized maximum likelihood.

    If larger inputs go with incorrect predictions, the probability does not depend on them. If all predictions are
    correct, it stays below 1: half a correct and half an incorrect prediction are added at the center.

    Args:
        values: of `confidence_inputs`; rows that are not finite, without a prediction or without candidates of other
            places, are left out.
        correct: whether the top prediction is correct; False for queries without a place in the database.
        inputs: names of the values.
        apart: with which the values were computed.

    Raises:
        InputError: no predictions.
    """
    there = np.isfinite(values).all(axis=1)
    values, correct = values[there], np.asarray(correct, bool)[there]
    if not len(values):
        raise InputError("confidence: expected predictions to fit it on, with candidates of other places, got none")
    center, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    columns = np.column_stack([np.ones(len(values)), (values - center) / scale])
    penalty = np.array([0.0, *[1.0] * values.shape[1]])

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds, bias = columns @ weights, weights[0]
        value = np.logaddexp(0, odds).sum() - odds[correct].sum() + penalty @ weights**2 / 2
        gradient = columns.T @ (scipy.special.expit(odds) - correct) + penalty * weights
        gradient[0] += scipy.special.expit(bias) - 0.5
        return value + np.logaddexp(0, bias) - bias / 2, gradient

    bounds = [(None, None), *[(0.0, None)] * values.shape[1]]
    options = {"ftol": 1e-13, "gtol": 1e-8, "maxiter": 1000}
    start = np.zeros(len(bounds))
    best = scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    bias, *weights = np.where(np.abs(best) > _LEAST_WEIGHT, best, 0.0).tolist()
    return Confidence(tuple(inputs), apart, tuple(center.tolist()), tuple(scale.tolist()), tuple(weights), bias)


class CalibrationData(NamedTuple):
    """Inputs of a confidence of Q queries, for places that the database shows and for absent places.

    Attributes:
        present: inputs of the queries as they are, see `confidence_inputs`.
        absent: inputs of the same queries without the images of their place; NaN without candidates of other places.
        correct: whether the top predictions of the queries as they are are correct.
    """

    present: Float[np.ndarray, "queries inputs"]
    absent: Float[np.ndarray, "queries inputs"]
    correct: Bool[np.ndarray, " queries"]

    @property
    def num_absent(self) -> int:
        """Number of queries that count once more, as images of an absent place."""
        return int(np.isfinite(self.absent).all(axis=1).sum())

    def take(self, queries: Int[np.ndarray, " _"]) -> "CalibrationData":
        """Select queries by their numbers."""
        return CalibrationData(*(values[queries] for values in self))

    def fit(self) -> Confidence:
        """Fit a confidence on present and absent places; an `InputError` if no query has usable inputs."""
        never = np.zeros(len(self.absent), bool)
        return fit_confidence(np.concatenate([self.present, self.absent]), np.concatenate([self.correct, never]))


def calibration_data(ranked: Ranked, by_retrieval: Ranked, truth: Truth, threshold: float) -> CalibrationData:
    """Count each query as it is, and once more as an image of an absent place, see `absent_rankings`.

        confidence = calibration_data(by_score, by_retrieval, truth, 2).fit()

    Args:
        ranked: of a system.
        by_retrieval: the ranking of the same candidates by retrieval.
        truth: ground truth of the queries.
        threshold: largest distance of a correct prediction.
    """
    absent = confidence_inputs(*absent_rankings(ranked, by_retrieval, truth, threshold))
    correct = truth.positives(threshold).contains(ranked.rows)[:, 0]
    return CalibrationData(confidence_inputs(ranked, by_retrieval), absent, correct)


def absent_rankings(ranked: Ranked, by_retrieval: Ranked, truth: Truth, threshold: float) -> tuple[Ranked, Ranked]:
    """Both rankings without the images of each query's place, as if the database did not show it.

    Images within five times the threshold are left out, and the other candidates keep their scores. A query without
    images to leave out has no candidates: it shows an absent place as it is. Arguments are those of `calibration_data`.
    """
    place = truth.shows_place(AROUND * max(threshold, 1))
    return _leave_out(ranked, place), _leave_out(by_retrieval, place)


def _leave_out(ranked: Ranked, place: Positives) -> Ranked:
    is_left_out = place.contains(ranked.rows) | (place.counts == 0)[:, None]
    order = np.argsort(is_left_out, axis=1, kind="stable")
    rows, scores = np.where(is_left_out, -1, ranked.rows), np.where(is_left_out, np.nan, ranked.scores)
    return Ranked(np.take_along_axis(rows, order, axis=1), np.take_along_axis(scores, order, axis=1))


def write_confidences(path: Path | str, systems: Mapping[str, Confidence], recipe: Mapping[str, Any]) -> None:
    """Write the confidences of systems by name as JSON, with the recipe of their rankings (JSON values).

    An earlier file of confidences is replaced; an InputError for other files.
    """
    values = {name: vars(confidence) for name, confidence in systems.items()}
    require_replaceable(Path(path), _FORMAT.encode())
    content = {"format": _FORMAT, "made": recipe, "systems": values}
    write_text(Path(path), json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_confidences(path: Path | str) -> tuple[dict[str, Confidence], dict[str, Any]]:
    """Read the file of `write_confidences`: confidences by name of the system, and the recipe."""
    path = Path(path)
    expected = "the confidence.json that an evaluation wrote"
    require_file(path, expected)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r}")
        return {name: confidence_from_json(values) for name, values in content["systems"].items()}, dict(
            content["made"]
        )
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        fix = "evaluate images with ground truth to make one"
        raise InputError(f"{path}: expected {expected} ({reason}); {fix}") from error


def confidence_from_json(values: Mapping[str, Any]) -> Confidence:
    """The confidence whose `vars` were written as JSON; a TypeError or ValueError for anything else."""
    return _confidence(**values)


def _confidence(
    *, inputs: list[Input], apart: int, bias: float, refusals: Sequence[float] = REFUSALS, **vectors: list[float]
) -> Confidence:
    arrays = [np.array(vectors.pop(name)) for name in ("center", "scale", "weights")]
    if any(array.dtype.kind not in "fi" for array in arrays):
        raise ValueError("expected lists of numbers")
    center, scale, weights = (tuple(array.astype(float).tolist()) for array in arrays)
    numbers = [bias, *center, *scale, *weights]
    same = len(inputs) == len(center) == len(scale) == len(weights)
    known = set(inputs) <= {"margin", "height", "retrieval", "score"}
    once = len({*inputs}) == len(inputs) and type(apart) is int and apart >= 0
    fitted = np.isfinite(numbers).all() and min(scale, default=0) > 0 and min(weights) >= 0
    on, off = refusals
    if vectors or not (same and known and once and fitted and 0 < on <= 1 and 0 < off <= 1):
        raise ValueError("values that make no model")
    return Confidence(tuple(inputs), apart, center, scale, weights, float(bias), (float(on), float(off)))
