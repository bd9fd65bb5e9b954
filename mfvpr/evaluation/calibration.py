"""How sure the first answer of a ranking is: p(right), from how its score stands out among the query's other scores.

Nothing of it has a unit, so that what was fitted on some images can say something of others: every difference of scores
is in units of their spread over the same query's candidates.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import optimize, special

from mfvpr.reranking.results import Ranked
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, write_text

Input = Literal["margin", "height", "filter", "score"]
INPUTS: tuple[Input, ...] = ("margin", "height")  # by default
APART = 5  # rows of the database, by default
_LEAST_SPREAD = 1e-3  # of the first score: less is rounding
_PRIOR = 2  # candidates of other places whose scores spread as those of all candidates, beside those that there are
_LEAST_WEIGHT = 1e-9  # of an input: less is where the search for it ended, and would order equal answers by rounding
_FORMAT = "mfvpr confidence 2"


def confidence_inputs(
    ranked: Ranked, filtered: Ranked, *, inputs: Sequence[Input] = INPUTS, apart: int = APART
) -> np.ndarray:
    """What p(right) of the first answers is computed from, `[Q, F]`; NaN where there is no answer.

    margin: log(1 + how far the first score is above that of the best candidate of another place), in units of the
        standard deviation of the scores of all candidates of other places, of few of them drawn towards that of all
        candidates; infinite where there are none, which says nothing.
    height: the same, above their mean.
    filter: minus the log of the best rank, from 1, that the filter gives to a candidate of the answer's place.
    score: inverse hyperbolic sine of the first score itself: not free of scale.

    The larger each is, the surer is the answer.

    Args:
        ranked: of a system, `[Q, C]`.
        filtered: the filter's own ranking of the same candidates.
        inputs: names of F inputs.
        apart: database images within so many rows of the answer are taken for its place.
    """
    there = (ranked.rows >= 0) & np.isfinite(ranked.scores)
    scores, first = np.where(there, ranked.scores, 0.0).astype(np.float64), ranked.rows[:, :1]
    others = there & (np.abs(ranked.rows - first) > apart)
    (count, mean, variance), (_, _, prior) = _moments(scores, others), _moments(scores, there)
    spread = np.sqrt((count * variance + _PRIOR * prior) / (count + _PRIOR))
    spread = np.maximum(np.maximum(spread, _LEAST_SPREAD * np.abs(scores[:, 0])), np.finfo(np.float64).tiny)
    second = np.max(scores, axis=1, where=others, initial=-np.inf)
    near = np.abs(filtered.rows - first) <= apart  # the answer is among them, before all that is no candidate
    above = {"margin": scores[:, 0] - second, "height": scores[:, 0] - mean}
    found = {name: np.where(others.any(axis=1), np.log1p(np.maximum(value, 0) / spread), np.inf)
             for name, value in above.items()}  # fmt: skip
    found |= {"filter": -np.log1p(np.argmax(near, axis=1)), "score": np.arcsinh(scores[:, 0])}
    return np.where(there[:, :1], np.stack([found[name] for name in inputs], axis=1), np.nan)


def _moments(scores: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`[Q]` how many scores `[Q, C]` there are, their mean and variance, 0 of none."""
    count = where.sum(axis=1)
    mean = np.sum(scores, axis=1, where=where) / np.maximum(count, 1)
    squares = np.sum((scores - mean[:, None]) ** 2, axis=1, where=where)
    return count, mean, squares / np.maximum(count, 1)


@dataclass(frozen=True)
class Confidence:
    """p(right) of a system's first answers: a logistic model, made by `fit_confidence`.

    Attributes:
        inputs: names, see `confidence_inputs`.
        apart: see there.
        center: of each input, where it was fitted.
        scale: likewise, its standard deviation.
        weights: of the inputs in these units.
        bias: log odds at the center.
    """

    inputs: tuple[Input, ...]
    apart: int
    center: tuple[float, ...]
    scale: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float

    def __call__(self, ranked: Ranked, filtered: Ranked) -> np.ndarray:
        """`[Q]` of rankings, NaN where there is no answer; see `confidence_inputs`."""
        return self.probability(confidence_inputs(ranked, filtered, inputs=self.inputs, apart=self.apart))

    def probability(self, inputs: np.ndarray) -> np.ndarray:
        """`[Q]` of inputs `[Q, F]`; infinite ones say nothing, as if they were where the model was fitted."""
        centered = (np.where(np.isinf(inputs), self.center, inputs) - self.center) / np.array(self.scale)
        return special.expit(centered @ np.array(self.weights) + self.bias)


def fit_confidence(
    values: np.ndarray, right: np.ndarray, *, inputs: Sequence[Input] = INPUTS, apart: int = APART, ridge: float = 1.0
) -> Confidence:
    """The logistic model, of weights not below 0, under which right and wrong answers are most probable.

    Where larger inputs go with wrong answers, p does not depend on them. Where all are right, p is near 1 and never 1:
    half a right and half a wrong answer more are thought to be at the center.

    Args:
        values: `[Q, F]` of `confidence_inputs`; rows that are not finite, without an answer or without candidates of
            other places, are left out.
        right: `[Q]` bool, of the first answers; of queries without a place in the database False.
        inputs: what the values are.
        apart: what they were computed with.
        ridge: penalty on weights: half of it times the sum of their squares, beside the log likelihood of all queries.

    Raises:
        InputError: no answers.
    """
    there = np.isfinite(values).all(axis=1)
    values, right = values[there], np.asarray(right, bool)[there]
    if not len(values):
        raise InputError("confidence: expected answers to fit it on, with candidates of other places, got none")
    center, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    columns = np.column_stack([np.ones(len(values)), (values - center) / scale])
    penalty = np.array([0.0, *[ridge] * values.shape[1]])

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds, bias = columns @ weights, weights[0]
        value = np.logaddexp(0, odds).sum() - odds[right].sum() + penalty @ weights**2 / 2
        gradient = columns.T @ (special.expit(odds) - right) + penalty * weights
        gradient[0] += special.expit(bias) - 0.5
        return value + np.logaddexp(0, bias) - bias / 2, gradient

    bounds = [(None, None), *[(0.0, None)] * values.shape[1]]
    options = {"ftol": 1e-13, "gtol": 1e-8, "maxiter": 1000}
    found = optimize.minimize(loss, np.zeros(len(bounds)), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    bias, *weights = np.where(np.abs(found.x) > _LEAST_WEIGHT, found.x, 0.0).tolist()
    return Confidence(tuple(inputs), apart, tuple(center.tolist()), tuple(scale.tolist()), tuple(weights), bias)


def write_confidences(path: Path | str, systems: Mapping[str, Confidence], made: Mapping[str, Any]) -> None:
    """Write the confidences of systems by name as JSON, with how they were made (JSON values)."""
    values = {name: {field.name: getattr(one, field.name) for field in fields(one)} for name, one in systems.items()}
    found = {"format": _FORMAT, "made": made, "systems": values}
    write_text(Path(path), json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_confidences(path: Path | str) -> tuple[dict[str, Confidence], dict[str, Any]]:
    """Those of `write_confidences` by system, and how they were made.

    Raises:
        InputError: no such file, or another one.
    """
    path = Path(path)
    require_file(path, "the confidence.json that an evaluation wrote")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["format"] != _FORMAT:
            raise ValueError(f"format {found['format']!r}")
        return {name: _confidence(**one) for name, one in found["systems"].items()}, dict(found["made"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: expected the confidence.json that an evaluation wrote ({reason}); evaluate images "
                         "with ground truth to make one") from error  # fmt: skip


def _confidence(*, inputs: list[Input], apart: int, bias: float, **vectors: list[float]) -> Confidence:
    arrays = [np.array(vectors.pop(name)) for name in ("center", "scale", "weights")]
    if any(array.dtype.kind not in "fi" for array in arrays):
        raise ValueError("expected lists of numbers")
    center, scale, weights = (tuple(array.astype(float).tolist()) for array in arrays)
    numbers = [bias, *center, *scale, *weights]
    same = len(inputs) == len(center) == len(scale) == len(weights)
    known = set(inputs) <= {"margin", "height", "filter", "score"}
    once = len({*inputs}) == len(inputs) and type(apart) is int and apart >= 0
    fitted = np.isfinite(numbers).all() and min(scale, default=0) > 0 and min(weights) >= 0
    if vectors or not (same and known and once and fitted):
        raise ValueError("values that make no model")
    return Confidence(tuple(inputs), apart, center, scale, weights, float(bias))
