"""Learned scores beside hand-set and grid-searched ones, on queries that none of them was chosen on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from mfvpr.errors import InputError
from mfvpr.evaluation import Judge, best_setting, hits
from mfvpr.learning.losses import Loss, cross_entropy
from mfvpr.learning.match_weight import LearnedWeight
from mfvpr.learning.models import Model, Parameters
from mfvpr.learning.parameters import can_learn
from mfvpr.learning.splits import Batch, TrainingSplit, training_splits
from mfvpr.learning.training import Fit, fit
from mfvpr.match_sets import MatchSet
from mfvpr.progress import untracked
from mfvpr.reranking import FilterScore, Ties
from mfvpr.scoring import Scorer, parameters
from mfvpr.sweeping import Axes, Setting, sweep
from mfvpr.sweeping.search import Stages, untracked_stages
from mfvpr.sweeping.settings import FUSION
from mfvpr.types import Shortlist
from mfvpr.weighting import UnitWeight

FIRST_SHARE = 0.3  # of the filter where learning starts, in units of what balances it


@dataclass(frozen=True)
class Options:
    """How scores are learned and compared.

    Attributes:
        c: weight of the filter where it is set by hand, None = balanced.
        filter_score: the filter's part of a combined score, as in `mfvpr.reranking.fuse_shortlist`.
        ties: as in `mfvpr.reranking.rank_shortlist`.
        loss: of one query.
        steps: updates of a training, at most.
        every: steps from one validation to the next.
        patience: validations without a gain after which to stop.
        batch: queries of a step.
        learning_rate: of Adam.
        hidden: width of the network of match weights.
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
    seed: int = 0


class Checkpoints(NamedTuple):
    """Where trainings are kept, and go on.

    folder: of all.
    recipe: JSON values, everything that the results depend on but for the half and the model.
    """

    folder: Path
    recipe: Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """One way to score, on one half.

    Attributes:
        half: where it was chosen or learned.
        name: of the way.
        hits: `[thresholds, R]` bool, of the queries of the other half.
        values: what was chosen or learned, plain.
        fitted: the training, where there was one.
    """

    half: str
    name: str
    hits: np.ndarray
    values: Mapping[str, Any]
    fitted: Fit | None


@dataclass(frozen=True)
class Comparison:
    """What became of all halves.

    Attributes:
        judge: what is right.
        match_set: of all queries.
        candidates: their shortlist.
        halves: the rows of each half, in the same order.
    """

    judge: Judge
    match_set: MatchSet
    candidates: Shortlist
    halves: Sequence[Sequence[Row]]

    def rows(self) -> Iterator[tuple[str, np.ndarray, Sequence[Row]]]:
        """Name, hits `[thresholds, R]` of all reported queries along the path, and the row of each half."""
        for same in zip(*self.halves, strict=True):
            yield same[0].name, self.judge.joined([row.hits for row in same]), same


def compare(
    axes: Axes, judge: Judge, match_set: MatchSet, candidates: Shortlist, options: Options | None = None, *,
    checkpoints: Checkpoints | None = None, track: Stages = untracked_stages,
) -> Comparison:  # fmt: skip
    """The scorer as it is, the best of the grid, and what gradients find: each alone and fused with the filter.

    Everything is chosen or learned on one half of the path, and reported on the other.

    Args:
        axes: the scorer, and the grid to search; an axis `c` is in units of the c that balances filter and score.
        judge: what is right, with halves.
        match_set: matches of Q queries with C candidates, with their ratio.
        candidates: their shortlist.
        options: how to learn.
        checkpoints: where a training that was interrupted goes on; None = nowhere.
        track: progress.

    Raises:
        InputError: the scorer has nothing to learn, a setting cannot be scored, a half has too few queries, or the
            checkpoints are of something else.
        TrainingError: a loss is not finite.
    """
    if not can_learn(axes.scorer):
        raise InputError(f"{type(axes.scorer).__name__}: expected a scorer with numbers to learn")
    axes.check(match_set.image_sizes)
    options = options or Options()
    splits = training_splits(match_set, candidates, judge, filter_score=options.filter_score)
    compared = [_Compared(split, axes, options, checkpoints, track) for split in splits]
    return Comparison(judge, match_set, candidates, [list(one.rows()) for one in compared])


@dataclass(frozen=True)
class _Compared:
    """One half of `compare`; the other fields are its arguments."""

    split: TrainingSplit
    axes: Axes
    options: Options
    checkpoints: Checkpoints | None
    track: Stages

    def rows(self) -> Iterator[Row]:
        """Each is reported as soon as it is chosen or learned."""
        own = self.axes.scorer
        yield self.reported("paper", own, {})
        yield self.reported("paper + filter", own, {FUSION: self.options.c})
        spread = self.split.spread(own)
        for fused in (False, True):
            name = "grid search" + " + filter" * fused
            chosen, plain = self.searched(name, spread, fused=fused)
            yield replace(self.reported(name, own, chosen), values=plain)
        for learned_weight in (False, True):
            for fused in (False, True):
                name = ("match weights" if learned_weight else "gradient") + " + filter" * fused
                model = start(self.split, own, self.options, fused=fused, learned_weight=learned_weight)
                fitted = self.learned(name, model)
                values = model.values(fitted.parameters)
                setting = {FUSION: values[FUSION]} if fused else {}
                row = self.reported(name, model.scorer_of(fitted.parameters), setting)
                yield replace(row, values=values, fitted=fitted)

    def reported(self, name: str, scorer: Scorer, setting: Setting) -> Row:
        """A scorer with the values of a setting, on the half that is reported on, with all candidates."""
        queries, judge = self.split.half.report, self.split.judge
        [first] = self.ranked(name, scorer, [setting], queries, self.split.candidates.mask)
        right = [hits(first, positives.take(queries)) for positives in judge.positives]
        return Row(self.split.name, name, np.stack(right), {}, None)

    def searched(self, name: str, spread: float, *, fused: bool) -> tuple[Setting, Mapping[str, Any]]:
        """The best setting of the grid on the half to choose on: as the sweep takes it, and plain."""
        axes = self.axes if fused else self.axes.without(FUSION)
        grid, queries, judge = axes.grid(), self.split.half.tune, self.split.judge
        settings = [self.fusing(axes.setting(plain), self.split.balance(spread), fused=fused) for plain in grid]
        rows = self.ranked(name, axes.scorer, settings, queries, self.split.seen)
        recall = hits(rows, judge.positives[judge.main].take(queries)).mean(axis=-1)
        best = best_setting(recall, axes.values)
        return settings[best], grid[best]

    def fusing(self, setting: Setting, balance: float, *, fused: bool) -> Setting:
        """With c in units of the scores, or that set by hand."""
        if fused and FUSION not in setting:
            return {**setting, FUSION: self.options.c}
        c = setting.get(FUSION)
        return setting if c is None else {**setting, FUSION: c * balance}

    def ranked(
        self, name: str, scorer: Scorer, settings: Sequence[Setting], queries: np.ndarray, seen: np.ndarray
    ) -> np.ndarray:
        """`[S, q, 1]` the first row of some queries' rankings of the candidates that are seen, by every setting."""
        track = self.track(f"{self.split.name}: {name}") if len(settings) > 1 else untracked
        part, views = self.split.part(queries), [seen[queries]]
        return sweep(scorer, settings, *part, views=views, depth=1, ties=self.options.ties, track=track)[0]

    def learned(self, name: str, model: Model) -> Fit:
        """The training, where it is kept as `half-name`."""
        folder, recipe = None, None
        if self.checkpoints:
            place = f"{self.split.name}-{name}".replace(" ", "_").replace("_+_", "_")
            folder = self.checkpoints.folder / place
            recipe = {**self.checkpoints.recipe, "half": self.split.name, "model": name}
        track = self.track(f"{self.split.name}: {name}")
        return train(self.split, model, self.options, folder=folder, recipe=recipe, track=track)


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
        sample = split.batch(split.train[: options.batch], options.batch)
        weight = LearnedWeight.create(jax.random.key(options.seed), sample.matches, options.hidden)
    spread = split.spread(scorer)
    c = FIRST_SHARE * split.balance(spread) if fused else None
    return Model.of(parameters.fit(scorer, *split.match_set.image_sizes), spread, c=c, weight=weight)


def train(split: TrainingSplit, model: Model, options: Options, **keeping: Any) -> Fit:
    """Learn a model's parameters on one half of the path.

    Args:
        split: to learn on.
        model: the start.
        options: how to learn.
        keeping: `folder`, `recipe` and `track` of `mfvpr.learning.training.fit`.
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
