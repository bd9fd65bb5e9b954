"""Models of learning: parameters to start from, and a differentiable score of the candidates of a query."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mfvpr.reranking.ranking import combine, score_candidates
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.learned_weight import LearnedWeight
from mfvpr.tuning.learning import losses
from mfvpr.tuning.learning.losses import Loss
from mfvpr.tuning.learning.parameters import from_logarithms, starts, to_logarithms
from mfvpr.tuning.learning.splits import Batch
from mfvpr.types import Array, Matches
from mfvpr.utils.numerics import masked_mean

Parameters = dict[str, Any]  # `numbers` by name and `c` as logarithms, `sharpness`, `weight`
Objective = Callable[["Parameters", Batch], Array]

SHARPNESS = 2.0  # of the loss at the start, per unit of the scores
LEAST_C = 1e-3  # weight of the retrieval at the start, in units of the scores


@dataclass(frozen=True)
class Model:
    """A score with parameters to learn.

    Attributes:
        scorer: its numbers are learned; its other parameters stay.
        start: the parameters to begin with.
        unit: spread of the scores at the start; the loss sees scores in this unit.
        teacher: labels the matches of correct pairs as correct or incorrect, from which the match weight is learned;
            None = learn from the ranking.
    """

    scorer: Any
    start: Parameters
    unit: float
    teacher: HistogramOfShifts | None = None

    @classmethod
    def of(cls, scorer: Any, unit: float, *, c: float | None = None, weight: LearnedWeight | None = None) -> "Model":
        """A model that starts from the values of a hard scorer, whose scores have the spread `unit`.

        It also learns the retrieval's weight c and the match weight, if they are given, from these values on.
        """
        start: Parameters = {
            "numbers": to_logarithms(starts(scorer, unit)),
            "sharpness": jnp.log(jnp.asarray(SHARPNESS)),
        }
        if c is not None:
            start["c"] = jnp.log(jnp.asarray(max(c, LEAST_C * unit) / unit))
        if weight is not None:
            start["weight"] = weight
        return cls(scorer, start, unit)

    @classmethod
    def of_matches(cls, scorer: Any, weight: LearnedWeight, teacher: HistogramOfShifts) -> "Model":
        """A model that learns only its match weight, starting with `weight`, from the labels of a teacher."""
        return cls(scorer, {"numbers": {}, "weight": weight}, 1.0, teacher)

    def scorer_of(self, parameters: Parameters) -> Any:
        """The soft scorer."""
        numbers = from_logarithms(parameters["numbers"])
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
