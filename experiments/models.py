"""What is learned: a model is its start, and how its parameters score the candidates of a query."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mfvpr
from mfvpr.learning import losses
from mfvpr.learning.match_weight import LearnedWeight
from mfvpr.learning.parameters import from_logarithms, starts, to_logarithms
from mfvpr.types import Array, Matches, value

LOSSES: dict[str, losses.Loss] = {
    "cross_entropy": losses.cross_entropy,
    "recall": lambda *query: losses.smooth_recall_at_1(*query, temperature=1.0),
    "average_precision": lambda *query: losses.smooth_average_precision(*query, temperature=1.0),
}


@value
class Lesson:
    """Queries to learn from, padded.

    matches: `[B, C, K, ...]`.  filter_scores: `[B, C]`.  positives, mask: `[B, C]` bool.
    """

    matches: Matches
    filter_scores: np.ndarray
    positives: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class Model:
    """One way to score.

    Attributes:
        name: for tables.
        scorer: whose numbers are learned; its other parameters stay.
        start: the parameters to begin with: logarithms by name, and a match weight.
        unit: spread of the scores at the start; what the loss sees is in this unit.
    """

    name: str
    scorer: Any
    start: dict[str, Any]
    unit: float

    def scorer_of(self, parameters: dict[str, Any]) -> Any:
        """The soft scorer."""
        numbers = from_logarithms(parameters["numbers"])
        weight = {"weight": parameters["weight"]} if "weight" in parameters else {}
        return replace(self.scorer, **numbers, **weight)

    def c_of(self, parameters: dict[str, Any]) -> Array | None:
        """Weight of the filter, None where it is not asked."""
        return self.unit * jnp.exp(parameters["c"]) if "c" in parameters else None

    def objective(self, loss: losses.Loss) -> Callable[[dict[str, Any], Lesson], Array]:
        """Parameters and a lesson -> loss."""

        def mean(parameters: dict[str, Any], lesson: Lesson) -> Array:
            scorer, c = self.scorer_of(parameters), self.c_of(parameters)
            scores = jax.vmap(lambda matches: mfvpr.score_candidates(scorer, matches))(lesson.matches)
            scores = scores if c is None else mfvpr.combine(lesson.filter_scores, scores, c=c)
            logits = scores / self.unit * jnp.exp(parameters["sharpness"])
            return losses.mean_loss(loss, logits, lesson.positives, lesson.mask)

        return mean


def model(name: str, scorer: Any, unit: float, *, fused: float | None, weight: LearnedWeight | None) -> Model:
    """A model that starts from a hard scorer's values.

    Args:
        name: for tables.
        scorer: the hand-set one.
        unit: spread of its scores.
        fused: the filter's weight to start with, in units of the score; None = not fused.
        weight: the match weight to start with; None = the scorer's own, not learned.
    """
    numbers = to_logarithms(starts(scorer, unit))
    start: dict[str, Any] = {"numbers": numbers, "sharpness": jnp.log(jnp.asarray(2.0))}
    if fused is not None:
        start["c"] = jnp.log(jnp.asarray(max(fused, 1e-3 * unit) / unit))
    if weight is not None:
        start["weight"] = weight
    return Model(name, scorer, start, unit)
