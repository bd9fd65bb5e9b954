"""Initial models for one half of a path, and their training."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mfvpr.baselines.learned_weight import RELATIVE, LearnedWeight
from mfvpr.core import parameters
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.weights import RatioWeight, UnitWeight
from mfvpr.evaluation.shortlist_scores import RetrievalScore, Ties
from mfvpr.tuning.learning.losses import Loss, cross_entropy
from mfvpr.tuning.learning.models import Model, Parameters, first_numbers
from mfvpr.tuning.learning.splits import Batch, TrainingSplit
from mfvpr.tuning.learning.training import Fit, Schedule, fit

TEACHER_SIGMA = 0.03  # of the teacher of single matches, in units of the largest side of an image
FIRST_SHARE = 0.3  # the retrieval's weight at the start, in units of the balanced weight
LEAST_C = 1e-3  # the same, at least, in units of the scores
SHARPNESS = 2.0  # of the loss at the start, per unit of the scores


@dataclass(frozen=True)
class Options:
    """Options of learning and comparing scores."""

    c: float | None = None  # the retrieval's weight if it is set by hand; None = balanced
    retrieval_score: RetrievalScore = "cosine"  # as in `mfvpr.evaluation.shortlist_scores.retrieval_scores`
    ties: Ties = "retrieval"  # as in `mfvpr.evaluation.shortlist_scores.rank_shortlist`
    loss: Loss = cross_entropy  # of one query
    steps: int = 200  # updates of a training, at most
    every: int = 5  # steps from one validation to the next
    patience: int = 10  # validations without a gain after which to stop
    batch: int = 8  # queries of a step
    learning_rate: float = 0.01  # of Adam
    hidden: int = 16  # width of the network of match weights
    inputs: tuple[str, ...] = RELATIVE  # properties of a match that the network sees, see `LearnedWeight`
    seed: int = 0  # of the network, and of the order of the queries


def start(
    split: TrainingSplit, scorer: Any, options: Options, *, fused: bool = False, learned_weight: bool = False
) -> Model:
    """The model that learns from rankings, starting from a hard scorer.

    It learns the retrieval's weight as well (`fused`), and the match weight, starting from 1 (`learned_weight`).
    """
    scorer = replace(scorer, weight=UnitWeight()) if learned_weight else scorer  # the start of a learned weight
    deviation = split.score_deviation(scorer)
    scorer = parameters.with_capacity(scorer, *split.match_set.image_sizes)
    first: Parameters = {"numbers": first_numbers(scorer, deviation), "sharpness": jnp.log(jnp.asarray(SHARPNESS))}
    if fused:
        c = FIRST_SHARE * split.balance(deviation)
        first["c"] = jnp.log(jnp.asarray(max(c, LEAST_C * deviation) / deviation))
    if learned_weight:
        first["weight"] = _first_weight(split, options)
    return Model(scorer, first, deviation)


def of_matches(split: TrainingSplit, scorer: Any, options: Options) -> Model:
    """The model that learns a match weight from labels of single matches."""
    sizes = split.match_set.image_sizes
    seen, _ = split.match_set.take(split.half.tune).image_sizes  # else reported images would change the labels
    sigma = TEACHER_SIGMA * float(np.max(seen))
    teacher = HistogramOfShifts(bin_size=sigma / 2, sigma=sigma, weight=RatioWeight())
    scorer = parameters.with_capacity(scorer, *sizes)
    first = {"numbers": {}, "weight": _first_weight(split, options)}
    return Model(scorer, first, 1.0, parameters.with_capacity(teacher, *sizes))


def _first_weight(split: TrainingSplit, options: Options) -> LearnedWeight:
    """A match weight of 1, with statistics of the matches of a few queries that are spread along the path."""
    queries = split.train[np.linspace(0, len(split.train) - 1, min(options.batch, len(split.train))).astype(int)]
    matches = split.batch(queries, options.batch).matches
    return LearnedWeight.create(jax.random.key(options.seed), matches, options.hidden, names=options.inputs)


def train(split: TrainingSplit, model: Model, options: Options, **keeping: Any) -> Fit:
    """Learn a model's parameters; `keeping` are `checkpoints` and `track` of `training.fit`."""
    size = options.batch
    objective = model.objective(options.loss)
    mean_loss = jax.jit(objective)
    parts = [split.validation[place : place + size] for place in range(0, len(split.validation), size)]
    validation = [(split.batch(part, size), len(part)) for part in parts]

    def batches(step: int) -> Batch:
        """The batch of a step: every query once per epoch, in an order that depends on the step alone."""
        epoch, place = divmod(step, -(-len(split.train) // size))
        order = np.random.default_rng([options.seed, epoch]).permutation(split.train)
        return split.batch(order[place * size : (place + 1) * size], size)

    def validate(learned: Parameters) -> float:
        return sum(float(mean_loss(learned, batch)) * count for batch, count in validation) / len(split.validation)

    schedule = Schedule(optax.adam(options.learning_rate), options.steps, options.every, options.patience)
    return fit(model.start, objective, batches, schedule, validate=validate, **keeping)
