"""What is learned: a model is its start, and how its parameters score the candidates of a query."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from mfvpr.learning import losses
from mfvpr.learning.losses import Loss
from mfvpr.learning.match_weight import LearnedWeight
from mfvpr.learning.parameters import from_logarithms, starts, to_logarithms
from mfvpr.learning.splits import Batch
from mfvpr.reranking import combine, score_candidates
from mfvpr.types import Array

Parameters = dict[str, Any]  # `numbers` by name and `c` as logarithms, `sharpness`, `weight`

SHARPNESS = 2.0  # of the loss at the start, per unit of the scores
LEAST_C = 1e-3  # of the filter at the start, in units of the scores


@dataclass(frozen=True)
class Model:
    """One way to score.

    Attributes:
        scorer: whose numbers are learned; its other parameters stay.
        start: the parameters to begin with.
        unit: spread of the scores at the start; what the loss sees is in this unit.
    """

    scorer: Any
    start: Parameters
    unit: float

    @classmethod
    def of(cls, scorer: Any, unit: float, *, c: float | None = None, weight: LearnedWeight | None = None) -> "Model":
        """A model that starts from a hard scorer's values.

        Args:
            scorer: the hand-set one.
            unit: spread of its scores.
            c: the filter's weight to start with; None = not fused.
            weight: the match weight to start with; None = the scorer's own, not learned.
        """
        numbers = to_logarithms(starts(scorer, unit))
        start: Parameters = {"numbers": numbers, "sharpness": jnp.log(jnp.asarray(SHARPNESS))}
        if c is not None:
            start["c"] = jnp.log(jnp.asarray(max(c, LEAST_C * unit) / unit))
        if weight is not None:
            start["weight"] = weight
        return cls(scorer, start, unit)

    def scorer_of(self, parameters: Parameters) -> Any:
        """The soft scorer."""
        numbers = from_logarithms(parameters["numbers"])
        weight = {"weight": parameters["weight"]} if "weight" in parameters else {}
        return replace(self.scorer, **numbers, **weight)

    def c_of(self, parameters: Parameters) -> Array | None:
        """Weight of the filter, None where it is not asked."""
        return self.unit * jnp.exp(parameters["c"]) if "c" in parameters else None

    def values(self, parameters: Parameters) -> dict[str, float]:
        """What was learned, by name, but for the match weight."""
        scorer, c = self.scorer_of(parameters), self.c_of(parameters)
        numbers = {name: float(getattr(scorer, name)) for name in parameters["numbers"]}
        return numbers if c is None else numbers | {"c": float(c)}

    def objective(self, loss: Loss) -> Callable[[Parameters, Batch], Array]:
        """Parameters and a batch -> mean loss of its queries."""

        def mean(parameters: Parameters, batch: Batch) -> Array:
            scorer, c = self.scorer_of(parameters), self.c_of(parameters)
            scores = jax.vmap(lambda matches: score_candidates(scorer, matches))(batch.matches)
            scores = scores if c is None else combine(batch.filter_scores, scores, c=c)
            logits = scores / self.unit * jnp.exp(parameters["sharpness"])
            return losses.mean_loss(loss, logits, batch.positives, batch.mask)

        return mean
