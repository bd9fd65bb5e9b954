"""Confidence: the probability that the top prediction is correct, from how its score stands out among the others.

Differences are in units of the spread of a query's scores, so that a model can be used for other images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Float

from mfvpr.evaluation.rankings import Ranked

Input = Literal["margin", "height", "retrieval", "score"]
INPUTS: tuple[Input, ...] = ("margin", "height")  # by default
APART = 5  # rows of the database, by default
REFUSALS = 0.2, 0.5  # shares of images without enough evidence, by default
_LEAST_SPREAD = 1e-3  # of the first score: less is rounding
_PRIOR = 2  # added candidates of other places, with the variance of all candidates


def confidence_inputs(
    ranked: Ranked, by_retrieval: Ranked, *, inputs: Sequence[Input] = INPUTS, apart: int = APART
) -> Float[np.ndarray, "queries inputs"]:
    """Inputs of the confidence in the top predictions; NaN without a prediction.

    margin: log(1 + x), where x is the difference of the first score and that of the best candidate of another place,
        divided by the standard deviation of the scores of candidates of other places. If there are few of them, that is
        drawn towards the standard deviation of all candidates; if there are none, the input is infinite.
    height: the same, with the mean score of candidates of other places instead of the best.
    retrieval: minus the log of the best rank, from 1, that the retrieval gives to a candidate of the predicted place.
    score: inverse hyperbolic sine of the first score itself, which depends on the scale of scores.

    A larger input means a more confident prediction.

    Args:
        ranked: of a system.
        by_retrieval: the ranking of the same candidates by retrieval.
        inputs: their names.
        apart: database images within this many rows of the prediction count as its place.
    """
    there = (ranked.rows >= 0) & np.isfinite(ranked.scores)
    scores, first = np.where(there, ranked.scores, 0.0).astype(np.float64), ranked.rows[:, :1]
    elsewhere = there & (np.abs(ranked.rows - first) > apart)
    (count, mean, variance), (_, _, prior) = _moments(scores, elsewhere), _moments(scores, there)
    spread = np.sqrt((count * variance + _PRIOR * prior) / (count + _PRIOR))
    spread = np.maximum(np.maximum(spread, _LEAST_SPREAD * np.abs(scores[:, 0])), np.finfo(np.float64).tiny)
    second = np.max(scores, axis=1, where=elsewhere, initial=-np.inf)
    near = np.abs(by_retrieval.rows - first) <= apart  # the prediction is among them; -1, no candidate, comes last
    above = {"margin": scores[:, 0] - second, "height": scores[:, 0] - mean}
    columns = {name: np.where(elsewhere.any(axis=1), np.log1p(np.maximum(value, 0) / spread), np.inf)
               for name, value in above.items()}  # fmt: skip
    columns |= {"retrieval": -np.log1p(np.argmax(near, axis=1)), "score": np.arcsinh(scores[:, 0])}
    return np.where(there[:, :1], np.stack([columns[name] for name in inputs], axis=1), np.nan)


def _moments(scores: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number `[Q]`, mean and variance of the scores `[Q, C]`; 0 if there are none."""
    count = where.sum(axis=1)
    mean = np.sum(scores, axis=1, where=where) / np.maximum(count, 1)
    squares = np.sum((scores - mean[:, None]) ** 2, axis=1, where=where)
    return count, mean, squares / np.maximum(count, 1)


@dataclass(frozen=True)
class Confidence:
    """A logistic model of the probability that a system's top prediction is correct, see `mfvpr.evaluation`.

    Attributes:
        inputs: names, see `confidence_inputs`.
        apart: see `confidence_inputs`.
        center: mean of each input over the data that the model was fitted on.
        scale: standard deviation of each input over these data.
        weights: of the inputs in these units.
        bias: log odds at the center.
        refusals: shares of images without enough evidence for a place (`mfvpr.evaluation.evidence`), of places that the
            database shows and of absent ones.
    """

    inputs: tuple[Input, ...]
    apart: int
    center: tuple[float, ...]
    scale: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float
    refusals: tuple[float, float] = REFUSALS

    def __call__(self, ranked: Ranked, by_retrieval: Ranked) -> Float[np.ndarray, " queries"]:
        """Probabilities, NaN without a prediction; for the arguments see `confidence_inputs`."""
        return self.probability(confidence_inputs(ranked, by_retrieval, inputs=self.inputs, apart=self.apart))

    def probability(self, inputs: Float[np.ndarray, "queries inputs"]) -> Float[np.ndarray, " queries"]:
        """Probabilities from inputs; an infinite input counts as its center."""
        centered = (np.where(np.isinf(inputs), self.center, inputs) - self.center) / np.array(self.scale)
        return scipy.special.expit(centered @ np.array(self.weights) + self.bias)
