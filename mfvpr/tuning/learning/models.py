"""Losses of a query's ranking, the models that learn from them, and their comparison with other scores.

A loss takes scores, positives and mask of the candidates of one query, and gives a number, smaller = better. Positives
are the correct candidates. Scores of padding may be anything. A query without a positive has the loss 0 and the
gradient 0. For `mean_loss`, set a temperature with `functools.partial`. A temperature is in units of the scores; a
temperature not above 0 makes the loss NaN.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float, Num

from mfvpr.baselines.learned_weight import RELATIVE, LearnedWeight
from mfvpr.core.batch import score_candidates
from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.core.ranking import combine
from mfvpr.core.scorer import SCORE, Scorer, fit_capacities, parameters_of
from mfvpr.core.types import Array, Matches, Shortlist
from mfvpr.core.weights import DescriptorDistanceWeight, FeatureScoreWeight, RatioWeight, UnitWeight
from mfvpr.evaluation.protocol import EvaluationProtocol, best_setting
from mfvpr.evaluation.rankings import RetrievalScore, Ties
from mfvpr.matchers.match_set import MatchSet
from mfvpr.tuning.learning.splits import Batch, TrainingSplit, training_splits
from mfvpr.tuning.learning.training import Checkpoints, Fit, Schedule, fit
from mfvpr.tuning.sweeps import FUSION, Axes, Setting, SweepOptions, can_learn, rank_settings
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float, masked, masked_mean, positive
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

Loss = Callable[[Array, Array, Array], Array]
Scores = Num[Array, " candidates"]
Mask = Bool[Array, " candidates"]


def cross_entropy(scores: Scores, positives: Mask, mask: Mask) -> Float[Array, ""]:
    """-log of the probability that softmax(scores) gives to all positives together, in nats."""
    scores, positives, real, teaches = _usable(scores, positives, mask)
    # The highest score is subtracted first: else scores in the thousands round a small loss away.
    scores = scores - jax.lax.stop_gradient(jnp.max(scores, where=real, initial=-jnp.inf))
    loss = jax.nn.logsumexp(scores, where=real) - jax.nn.logsumexp(scores, where=positives)
    return jnp.where(teaches, loss, 0.0)


def smooth_recall_at_1(
    scores: Scores, positives: Mask, mask: Mask, temperature: float | Float[Array, ""]
) -> Float[Array, ""]:
    """1 - the probability that softmax(scores / temperature) gives to the positives, in [0, 1].

    It tends to 1 - R@1 as the temperature tends to 0.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    probability = jax.nn.softmax(scores / positive(temperature, scores.dtype), where=real)
    return jnp.where(teaches, jnp.sum(masked(probability, ~positives)), 0.0)


def smooth_average_precision(
    scores: Scores, positives: Mask, mask: Mask, temperature: float | Float[Array, ""]
) -> Float[Array, ""]:
    """1 - Smooth-AP (Brown et al., ECCV 2020, equation 4), in [0, 1].

    The rank of a candidate is 1 + the sum of sigmoid(lead / temperature) over all other candidates, where lead is how
    far their score is above its own. The loss tends to 1 - average precision as the temperature tends to 0; a tie
    counts half.
    """
    scores, positives, real, teaches = _usable(scores, positives, mask)
    lead = jax.nn.sigmoid((scores[None] - scores[:, None]) / positive(temperature, scores.dtype))  # [i, j] of j over i
    is_other = real[None] & ~jnp.eye(len(real), dtype=bool)
    rank = 1 + jnp.sum(masked(lead, is_other), axis=1)
    rank_among_positives = 1 + jnp.sum(masked(lead, is_other & positives[None]), axis=1)
    return jnp.where(teaches, 1 - masked_mean(rank_among_positives / rank, positives), 0.0)


LOSSES: dict[str, Loss] = {  # of the programs
    "cross_entropy": cross_entropy,
    "recall": partial(smooth_recall_at_1, temperature=1.0),
    "average_precision": partial(smooth_average_precision, temperature=1.0),
}


def mean_loss(
    loss: Loss,
    scores: Num[Array, "queries candidates"],
    positives: Bool[Array, "queries candidates"],
    mask: Bool[Array, "queries candidates"],
) -> Float[Array, ""]:
    """Mean of the loss of one query over the queries with a positive; 0 if there are none."""
    return masked_mean(jax.vmap(loss)(scores, positives, mask), jnp.any(positives & mask, axis=-1))


def _usable(scores: Array, positives: Array, mask: Array) -> tuple[Array, Array, Array, Array]:
    """Scores, positives, real candidates, and whether the query has a positive; without one, no loss divides by 0."""
    positives = positives & mask
    teaches = jnp.any(positives)
    return masked(as_float(scores), mask & teaches), positives | ~teaches, mask | ~teaches, teaches


TEACHER_SIGMA = 0.03  # of the teacher of single matches, in units of the largest side of an image
FIRST_SHARE = 0.3  # the retrieval's weight at the start, in units of the balanced weight
LEAST_C = 1e-3  # the same, at least, in units of the scores
SHARPNESS = 2.0  # of the loss at the start, per unit of the scores

# `numbers` by name, `c` and `sharpness` as logarithms, which keeps them above 0, and `weight`
Parameters = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Options of learning and comparing scores."""

    c: float | None = None  # the retrieval's weight if it is set by hand; None = balanced
    retrieval_score: RetrievalScore = "cosine"  # as in `mfvpr.evaluation.rankings.retrieval_scores`
    ties: Ties = "retrieval"  # as in `mfvpr.evaluation.rankings.rank_shortlist`
    loss: Loss = cross_entropy  # of one query
    steps: int = 200  # updates of a training, at most
    every: int = 5  # steps from one validation to the next
    patience: int = 10  # validations without a gain after which to stop
    batch: int = 8  # queries of a step
    learning_rate: float = 0.01  # of Adam
    hidden: int = 16  # width of the network of match weights
    inputs: tuple[str, ...] = RELATIVE  # properties of a match that the network sees, see `LearnedWeight`
    seed: int = 0  # of the network, and of the order of the queries


@dataclass(frozen=True)
class Model:
    """A score with parameters to learn, from the ranking, or from a teacher's labels of single matches."""

    scorer: Any  # its numbers are learned; its other parameters stay
    start: Parameters
    unit: float = 1.0  # spread of the scores at the start; the loss sees scores in this unit
    teacher: HistogramOfShifts | None = None  # labels the matches of correct pairs as correct or incorrect

    @classmethod
    def of_ranking(
        cls, split: TrainingSplit, scorer: Any, options: Options, *, fused: bool = False, learned_weight: bool = False
    ) -> "Model":
        """The model that learns from rankings, starting from a hard scorer.

        It learns the retrieval's weight as well (`fused`), and the match weight, starting from 1 (`learned_weight`).
        """
        scorer = replace(scorer, weight=UnitWeight()) if learned_weight else scorer
        deviation, numbers = split.score_deviation(scorer), {}
        for name, field in parameters_of(scorer).items():
            if field.learned:
                value, default = getattr(scorer, name), field.start * (deviation if field.unit == SCORE else 1.0)
                numbers[name] = jnp.log(as_float(float(default if value is None else value)))
        start: Parameters = {"numbers": numbers, "sharpness": jnp.log(jnp.asarray(SHARPNESS))}
        if fused:
            c = max(FIRST_SHARE * split.balance(deviation), LEAST_C * deviation)
            start["c"] = jnp.log(jnp.asarray(c / deviation))
        if learned_weight:
            start["weight"] = _first_weight(split, options)
        return cls(fit_capacities(scorer, *split.match_set.image_sizes), start, deviation)

    @classmethod
    def of_matches(cls, split: TrainingSplit, scorer: Any, options: Options) -> "Model":
        """The model that learns a match weight from labels of single matches."""
        sizes = split.match_set.image_sizes
        seen, _ = split.match_set.take(split.half.tune).image_sizes  # else reported images would change the labels
        sigma = TEACHER_SIGMA * float(np.max(seen))
        teacher = HistogramOfShifts(bin_size=sigma / 2, sigma=sigma, weight=RatioWeight())
        start = {"numbers": {}, "weight": _first_weight(split, options)}
        return cls(fit_capacities(scorer, *sizes), start, teacher=fit_capacities(teacher, *sizes))

    def scorer_of(self, parameters: Parameters) -> Any:
        """The soft scorer."""
        numbers = {name: jnp.exp(logarithm) for name, logarithm in parameters["numbers"].items()}
        weight = {"weight": parameters["weight"]} if "weight" in parameters else {}
        return replace(self.scorer, **numbers, **weight)

    def values(self, parameters: Parameters) -> dict[str, float]:
        """Learned values by name, with the weight `c` of the retrieval if it is learned, without the match weight."""
        values = {name: jnp.exp(logarithm) for name, logarithm in parameters["numbers"].items()}
        values |= {"c": self.unit * jnp.exp(parameters["c"])} if "c" in parameters else {}
        return {name: float(value) for name, value in values.items()}

    def objective(self, loss: Loss) -> Callable[[Parameters, Batch], Array]:
        """A function of parameters and a batch: the mean loss of its queries, or of its matches with a teacher."""

        def ranking_loss(parameters: Parameters, batch: Batch) -> Array:
            scorer = self.scorer_of(parameters)
            scores = jax.vmap(lambda matches: score_candidates(scorer, matches))(batch.matches)
            if "c" in parameters:
                scores = combine(batch.retrieval_scores, scores, c=self.unit * jnp.exp(parameters["c"]))
            logits = scores / self.unit * jnp.exp(parameters["sharpness"])
            return mean_loss(loss, logits, batch.positives, batch.mask)

        return ranking_loss if self.teacher is None else partial(_match_loss, self.teacher)


def _first_weight(split: TrainingSplit, options: Options) -> LearnedWeight:
    """A match weight of 1, with statistics of the matches of a few queries that are spread along the path."""
    queries = split.train[np.linspace(0, len(split.train) - 1, min(options.batch, len(split.train))).astype(int)]
    matches = split.batch(queries, options.batch).matches
    return LearnedWeight.create(jax.random.key(options.seed), matches, options.hidden, names=options.inputs)


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


_OF_THE_PAPER = (FeatureScoreWeight, DescriptorDistanceWeight, UnitWeight)


@dataclass(frozen=True)
class Row:
    """One score, chosen or learned on the named half and evaluated on the other."""

    half: str
    name: str
    hits: Bool[np.ndarray, "tolerances reported"]
    values: Mapping[str, Any]  # chosen or learned parameters
    fitted: Fit | None  # None if nothing was trained


@dataclass(frozen=True)
class Comparison:
    """The scores of all halves: `halves` has the rows of each half, in the same order."""

    protocol: EvaluationProtocol
    halves: Sequence[Sequence[Row]]

    def rows(self) -> Iterator[tuple[str, np.ndarray, Sequence[Row]]]:
        """Name, hits `[tolerances, reported]` of all reported queries along the path, and the row of each half."""
        for rows in zip(*self.halves, strict=True):
            yield rows[0].name, self.protocol.join_halves([row.hits for row in rows]), rows


def compare(
    axes: Axes,
    protocol: EvaluationProtocol,
    match_set: MatchSet,
    candidates: Shortlist,
    options: Options | None = None,
    *,
    checkpoints: Checkpoints | None = None,
    runtime: Runtime = DEFAULT_RUNTIME,
) -> Comparison:
    """Compare a scorer as it is, weighted by the ratio, the best of a grid, and learned: each alone and fused.

    Everything is chosen or learned on one half of the path, or some data sets, and reported on the other. "gradient"
    learns the scorer's parameters through the ranking, and "match weights" the weights as well. "match labels" learns
    weights from labels of matches: a match is correct if it is one of a correct pair and agrees with the dominant
    shift. Matches need their ratio; an axis `c` is in units of the c that balances retrieval and score.

    Raises:
        InputError: the scorer has nothing to learn or no match weight, a setting cannot be scored, a half has too few
            queries, or the checkpoints are of more steps.
        TrainingError: a loss is not finite.
    """
    if not can_learn(axes.scorer) or not hasattr(axes.scorer, "weight"):
        raise InputError(f"{type(axes.scorer).__name__}: expected a scorer with numbers to learn and a match weight")
    options = options or Options()
    splits = training_splits(match_set, candidates, protocol, retrieval_score=options.retrieval_score)
    halves = [list(HalfComparison(split, axes, options, checkpoints, runtime).rows()) for split in splits]
    return Comparison(protocol, halves)


@dataclass(frozen=True)
class HalfComparison:
    """One half of `compare`; the other fields are its arguments."""

    split: TrainingSplit
    axes: Axes
    options: Options
    checkpoints: Checkpoints | None = None
    runtime: Runtime = DEFAULT_RUNTIME

    def rows(self) -> Iterator[Row]:
        """All scores, each evaluated as soon as it is chosen or learned."""
        split, options = self.split, self.options
        scorer: Any = self.axes.scorer
        by_hand = {"paper" if isinstance(scorer.weight, _OF_THE_PAPER) else "as set": scorer}
        by_hand["1 - ratio"] = replace(scorer, weight=RatioWeight())
        for name, hand_set in by_hand.items():
            yield self.evaluate(name, hand_set, {})
            yield self.evaluate(f"{name} + retrieval", hand_set, {FUSION: options.c})
        for name, setting, values in self.search():
            yield self.evaluate(name, scorer, setting, values)
        for learned_weight, fused in itertools.product((False, True), repeat=2):
            name = ("match weights" if learned_weight else "gradient") + " + retrieval" * fused
            model = Model.of_ranking(split, scorer, options, fused=fused, learned_weight=learned_weight)
            fitted = self.learn(name, model)
            values = model.values(fitted.parameters)
            setting = {FUSION: values[FUSION]} if fused else {}
            yield self.evaluate(name, model.scorer_of(fitted.parameters), setting, values, fitted)
        name, model = "match labels", Model.of_matches(split, scorer, options)
        fitted = self.learn(name, model)
        learned = model.scorer_of(fitted.parameters)
        yield self.evaluate(name, learned, {}, fitted=fitted)
        yield self.evaluate(f"{name} + retrieval", learned, {FUSION: options.c})

    def evaluate(
        self, name: str, scorer: Scorer, setting: Setting, values: Any = None, fitted: Fit | None = None
    ) -> Row:
        """Evaluate a setting on the half to report on, with all candidates."""
        queries = self.split.half.report
        [first] = self.first_rows(name, scorer, [setting], queries, self.split.candidates.mask)
        return Row(self.split.name, name, self.split.protocol.hits(first, queries), values or {}, fitted)

    def search(self) -> Iterator[tuple[str, Setting, Mapping[str, Any]]]:
        """The best settings of the grid on the half to choose on, without and with retrieval.

        Each has a name, its values as a sweep takes them, and its plain values.
        """
        queries, protocol, scorer = self.split.half.tune, self.split.protocol, self.axes.scorer
        balanced_c = self.split.balance(self.split.score_deviation(scorer))  # in units of the scores
        alone = Axes(scorer, {name: axis for name, axis in self.axes.values.items() if name != FUSION})
        settings, fused = ([dict(axes.setting(plain)) for plain in axes.grid()] for axes in (alone, self.axes))
        for setting in fused:
            c = setting.get(FUSION)
            setting[FUSION] = self.options.c if FUSION not in setting else None if c is None else c * balanced_c
        rows = self.first_rows("grid search", scorer, settings + fused, queries, self.split.seen)
        recall = protocol.hits(rows, queries)[protocol.main].mean(axis=-1)
        best = best_setting(recall[: len(settings)], alone.values)
        yield "grid search", settings[best], alone.grid()[best]
        best = best_setting(recall[len(settings) :], self.axes.values)
        yield "grid search + retrieval", fused[best], self.axes.grid()[best]

    def first_rows(
        self, name: str, scorer: Scorer, settings: Sequence[Setting], queries: np.ndarray, seen: np.ndarray
    ) -> np.ndarray:
        """First rows `[S, q, 1]` of the rankings of the seen candidates by every setting."""
        runtime = self.runtime if len(settings) > 1 else Runtime(self.runtime.devices)  # silent
        options = SweepOptions(ks=(1,), ties=self.options.ties, runtime=runtime, label=f"{self.split.name}: {name}")
        return rank_settings(scorer, settings, *self.split.part(queries), views=[seen[queries]], options=options)[0]

    def learn(self, name: str, model: Model) -> Fit:
        """Train a model, with a checkpoint of its own."""
        split, options, checkpoints = self.split, self.options, self.checkpoints
        size, objective = options.batch, model.objective(options.loss)
        loss = jax.jit(objective)
        parts = [split.validation[place : place + size] for place in range(0, len(split.validation), size)]
        validation = [(split.batch(part, size), len(part)) for part in parts]

        def batches(step: int) -> Batch:
            """The batch of a step: every query once per epoch, in an order that depends on the step alone."""
            epoch, place = divmod(step, -(-len(split.train) // size))
            order = np.random.default_rng([options.seed, epoch]).permutation(split.train)
            return split.batch(order[place * size : (place + 1) * size], size)

        def validate(learned: Parameters) -> float:
            return sum(float(loss(learned, batch)) * count for batch, count in validation) / len(split.validation)

        if checkpoints:
            recipe = {**checkpoints.recipe, "half": split.name, "model": name}
            label = f"{split.name}-{name}".replace(" ", "_").replace("_+_", "_")
            checkpoints = Checkpoints(checkpoints.folder, recipe, label)
        schedule = Schedule(optax.adam(options.learning_rate), options.steps, options.every, options.patience)
        track = self.runtime.progress(f"{split.name}: {name}")
        return fit(model.start, objective, batches, schedule, validate=validate, checkpoints=checkpoints, track=track)
