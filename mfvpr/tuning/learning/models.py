"""Models of learning: parameters to start from, and a differentiable score of the candidates of a query."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mfvpr.baselines.learned_weight import LearnedWeight
from mfvpr.core.batch import score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.parameters import SCORE, parameters_of
from mfvpr.core.ranking import combine
from mfvpr.core.types import Array, Matches
from mfvpr.tuning.learning import losses
from mfvpr.tuning.learning.losses import Loss
from mfvpr.tuning.learning.splits import Batch
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float, masked_mean

# `numbers` by name, `c` and `sharpness` as logarithms, which keeps them above 0, and `weight`
Parameters = dict[str, Any]
Objective = Callable[["Parameters", Batch], Array]


@dataclass(frozen=True)
class Model:
    """A score with parameters to learn, from the ranking, or from a teacher's labels of single matches."""

    scorer: Any  # its numbers are learned; its other parameters stay
    start: Parameters
    unit: float  # spread of the scores at the start; the loss sees scores in this unit
    teacher: HistogramOfShifts | None = None  # labels the matches of correct pairs as correct or incorrect

    def scorer_of(self, parameters: Parameters) -> Any:
        """The soft scorer."""
        numbers = {name: jnp.exp(logarithm) for name, logarithm in parameters["numbers"].items()}
        weight = {"weight": parameters["weight"]} if "weight" in parameters else {}
        return replace(self.scorer, **numbers, **weight)

    def c_of(self, parameters: Parameters) -> Array | None:
        """Weight of the retrieval; None if the score is not fused."""
        return self.unit * jnp.exp(parameters["c"]) if "c" in parameters else None

    def values(self, parameters: Parameters) -> dict[str, float]:
        """Learned values by name, without the match weight."""
        scorer, c = self.scorer_of(parameters), self.c_of(parameters)
        numbers = {name: float(getattr(scorer, name)) for name in parameters["numbers"]}
        return numbers if c is None else numbers | {"c": float(c)}

    def objective(self, loss: Loss) -> Objective:
        """A function of parameters and a batch: the mean loss of its queries, or of its matches with a teacher."""
        return partial(self._ranking_loss, loss) if self.teacher is None else partial(_match_loss, self.teacher)

    def _ranking_loss(self, loss: Loss, parameters: Parameters, batch: Batch) -> Array:
        scorer, c = self.scorer_of(parameters), self.c_of(parameters)
        scores = jax.vmap(lambda matches: score_candidates(scorer, matches))(batch.matches)
        scores = scores if c is None else combine(batch.retrieval_scores, scores, c=c)
        logits = scores / self.unit * jnp.exp(parameters["sharpness"])
        return losses.mean_loss(loss, logits, batch.positives, batch.mask)


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of scorers, has fields that are declared to be learned."""
    return any(parameter.learned for parameter in parameters_of(scorer).values())


def first_numbers(scorer: Any, spread: float) -> dict[str, Array]:
    """Logarithms of the values to start learning from, by field: the scorer's values, or declared ones for None.

    `spread` is the standard deviation of the scores. A value that is not above 0 raises an `InputError`.
    """
    numbers = {}
    for name, field in parameters_of(scorer).items():
        if field.learned:
            default = field.start * (spread if field.unit == SCORE else 1.0)
            value = getattr(scorer, name)
            number = float(default if value is None else value)
            if not 0 < number < math.inf:
                raise InputError(f"{name}={number}: expected a number above 0 to start from")
            numbers[name] = jnp.log(as_float(number))
    return numbers


def _match_loss(teacher: HistogramOfShifts, parameters: Parameters, batch: Batch) -> Array:
    """Cross entropy of the labels of matches, `[]`, in nats; correct and incorrect ones have the same total weight."""
    weight: LearnedWeight = parameters["weight"]

    def logits_and_labels(matches: Matches, positive: Array) -> tuple[Array, Array]:
        peak = teacher.dominant_shift(matches, refine=True)
        return weight.logits(matches), teacher.agrees(matches, peak) & positive

    of_pairs = jax.vmap(jax.vmap(logits_and_labels))(batch.matches, batch.positives)
    logits, correct = (values.reshape(-1) for values in of_pairs)
    incorrect = (batch.matches.mask & batch.mask[..., None]).reshape(-1) & ~correct
    return (masked_mean(jax.nn.softplus(-logits), correct) + masked_mean(jax.nn.softplus(logits), incorrect)) / 2
