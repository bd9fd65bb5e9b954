"""Confidences fitted on predictions that are known to be correct or incorrect, and their files."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Bool, Float

from mfvpr.reranking.confidence import APART, INPUTS, Confidence, Input, confidence_inputs
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, write_text

__all__ = ["Confidence", "confidence_inputs", "fit_confidence", "read_confidences", "write_confidences"]

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


def write_confidences(path: Path | str, systems: Mapping[str, Confidence], recipe: Mapping[str, Any]) -> None:
    """Write the confidences of systems by name as JSON, with the recipe of their rankings (JSON values)."""
    values = {name: vars(confidence) for name, confidence in systems.items()}
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
        return {name: _confidence(**values) for name, values in content["systems"].items()}, dict(content["made"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        fix = "evaluate images with ground truth to make one"
        raise InputError(f"{path}: expected {expected} ({reason}); {fix}") from error


def _confidence(*, inputs: list[Input], apart: int, bias: float, **vectors: list[float]) -> Confidence:
    arrays = [np.array(vectors.pop(name)) for name in ("center", "scale", "weights")]
    if any(array.dtype.kind not in "fi" for array in arrays):
        raise ValueError("expected lists of numbers")
    center, scale, weights = (tuple(array.astype(float).tolist()) for array in arrays)
    numbers = [bias, *center, *scale, *weights]
    same = len(inputs) == len(center) == len(scale) == len(weights)
    known = set(inputs) <= {"margin", "height", "retrieval", "score"}
    once = len({*inputs}) == len(inputs) and type(apart) is int and apart >= 0
    fitted = np.isfinite(numbers).all() and min(scale, default=0) > 0 and min(weights) >= 0
    if vectors or not (same and known and once and fitted):
        raise ValueError("values that make no model")
    return Confidence(tuple(inputs), apart, center, scale, weights, float(bias))
