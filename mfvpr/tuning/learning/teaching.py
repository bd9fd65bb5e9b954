"""Where learning starts on one half of a path, and its training."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import optax

from mfvpr.reranking.ranking import FilterScore, Ties
from mfvpr.scoring import parameters
from mfvpr.scoring.histogram import HistogramOfShifts
from mfvpr.scoring.learned_weight import RELATIVE, LearnedWeight
from mfvpr.scoring.weights import RatioWeight, UnitWeight
from mfvpr.tuning.learning.losses import Loss, cross_entropy
from mfvpr.tuning.learning.models import Model, Parameters
from mfvpr.tuning.learning.splits import Batch, TrainingSplit
from mfvpr.tuning.learning.training import Fit, fit

TEACHER_SIGMA = 0.03  # of the teacher of single matches, in units of the largest side of an image
FIRST_SHARE = 0.3  # of the filter where learning starts, in units of what balances it


@dataclass(frozen=True)
class Options:
    """How scores are learned and compared.

    Attributes:
        c: weight of the filter where it is set by hand, None = balanced.
        filter_score: the filter's part of a combined score, as in `mfvpr.reranking.ranking.fuse_shortlist`.
        ties: as in `mfvpr.reranking.ranking.rank_shortlist`.
        loss: of one query.
        steps: updates of a training, at most.
        every: steps from one validation to the next.
        patience: validations without a gain after which to stop.
        batch: queries of a step.
        learning_rate: of Adam.
        hidden: width of the network of match weights.
        inputs: what that network sees of a match, see `LearnedWeight`.
        seed: of that network, and of the order of the queries.
    """

    c: float | None = None
    filter_score: FilterScore = "cosine"
    ties: Ties = "filter"
    loss: Loss = cross_entropy
    steps: int = 200
    every: int = 5
    patience: int = 10
    batch: int = 8
    learning_rate: float = 0.01
    hidden: int = 16
    inputs: tuple[str, ...] = RELATIVE
    seed: int = 0


def start(
    split: TrainingSplit, scorer: Any, options: Options, *, fused: bool = False, learned_weight: bool = False
) -> Model:
    """Where learning starts, from a hard scorer.

    Args:
        split: to learn on.
        scorer: the hand-set one.
        options: how to learn.
        fused: whether the filter's weight is learned as well.
        learned_weight: whether the match weight is, from 1 for every match.
    """
    weight = None
    if learned_weight:
        scorer = replace(scorer, weight=UnitWeight())  # what a learned weight starts as
        weight = _first_weight(split, options)
    spread = split.spread(scorer)
    c = FIRST_SHARE * split.balance(spread) if fused else None
    return Model.of(parameters.fit(scorer, *split.match_set.image_sizes), spread, c=c, weight=weight)


def of_matches(split: TrainingSplit, scorer: Any, options: Options) -> Model:
    """Where learning from single matches starts.

    Args:
        split: to learn on.
        scorer: the hand-set one.
        options: how to learn.
    """
    sizes = split.match_set.image_sizes
    seen, _ = split.match_set.take(split.half.tune).image_sizes  # or reported images would change what is taught
    sigma = TEACHER_SIGMA * float(np.max(seen))
    teacher = HistogramOfShifts(bin_size=sigma / 2, sigma=sigma, weight=RatioWeight())
    scorer = parameters.fit(scorer, *sizes)
    return Model.of_matches(scorer, _first_weight(split, options), parameters.fit(teacher, *sizes))


def _first_weight(split: TrainingSplit, options: Options) -> LearnedWeight:
    """1 for every match, with the statistics of a few queries from everywhere along the path."""
    some = split.train[np.linspace(0, len(split.train) - 1, min(options.batch, len(split.train))).astype(int)]
    matches = split.batch(some, options.batch).matches
    return LearnedWeight.create(jax.random.key(options.seed), matches, options.hidden, names=options.inputs)


def train(split: TrainingSplit, model: Model, options: Options, **keeping: Any) -> Fit:
    """Learn a model's parameters on one half of the path.

    Args:
        split: to learn on.
        model: the start.
        options: how to learn.
        keeping: `folder`, `recipe` and `track` of `mfvpr.tuning.learning.training.fit`.
    """
    size = options.batch
    objective = model.objective(options.loss)
    validated = jax.jit(objective)
    parts = [split.validation[place : place + size] for place in range(0, len(split.validation), size)]
    validation = [(split.batch(part, size), len(part)) for part in parts]

    def batches(step: int) -> Batch:
        """Every query once before any comes again, in an order that the step alone decides."""
        epoch, place = divmod(step, -(-len(split.train) // size))
        order = np.random.default_rng([options.seed, epoch]).permutation(split.train)
        return split.batch(order[place * size : (place + 1) * size], size)

    def validate(learned: Parameters) -> float:
        return sum(float(validated(learned, batch)) * count for batch, count in validation) / len(split.validation)

    return fit(
        model.start, objective, batches, optimizer=optax.adam(options.learning_rate), steps=options.steps,
        validate=validate, every=options.every, patience=options.patience, **keeping,
    )  # fmt: skip
