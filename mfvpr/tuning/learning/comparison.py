"""Comparison of learned, hand-set and grid-searched scores, on queries that none of them was chosen on."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.core.scorer import Scorer
from mfvpr.core.types import Shortlist
from mfvpr.core.weights import DescriptorDistanceWeight, FeatureScoreWeight, RatioWeight, UnitWeight
from mfvpr.evaluation.protocol import EvaluationProtocol, best_setting
from mfvpr.matchers.match_set import MatchSet
from mfvpr.tuning.learning.models import Model, Options, train
from mfvpr.tuning.learning.splits import TrainingSplit, training_splits
from mfvpr.tuning.learning.training import Checkpoints, Fit
from mfvpr.tuning.sweeps import FUSION, Axes, Setting, SweepOptions, can_learn, rank_settings
from mfvpr.utils.errors import InputError
from mfvpr.utils.runtime import DEFAULT_RUNTIME, Runtime

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
    match_set: MatchSet
    candidates: Shortlist
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

    Everything is chosen or learned on one half of the path and reported on the other, or chosen on some data sets and
    reported on others. "gradient" learns the scorer's parameters through the ranking, and "match weights" the weights
    as well. "match labels" learns weights from labels of matches: a match is correct if it is one of a correct pair and
    agrees with the dominant shift.

    Args:
        axes: the scorer, and the grid to search; an axis `c` is in units of the c that balances retrieval and score.
        protocol: the ground truth, with halves.
        match_set: matches of all queries, with their ratio.

    Raises:
        InputError: the scorer has nothing to learn or no match weight, a setting cannot be scored, a half has too few
            queries, or the checkpoints belong to another training.
        TrainingError: a loss is not finite.
    """
    if not can_learn(axes.scorer) or not hasattr(axes.scorer, "weight"):
        raise InputError(f"{type(axes.scorer).__name__}: expected a scorer with numbers to learn and a match weight")
    options = options or Options()
    splits = training_splits(match_set, candidates, protocol, retrieval_score=options.retrieval_score)
    halves = [list(HalfComparison(split, axes, options, checkpoints, runtime).rows()) for split in splits]
    return Comparison(protocol, match_set, candidates, halves)


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
        track, checkpoints = self.runtime.progress(f"{self.split.name}: {name}"), self.checkpoints
        if checkpoints:
            recipe = {**checkpoints.recipe, "half": self.split.name, "model": name}
            label = f"{self.split.name}-{name}".replace(" ", "_").replace("_+_", "_")
            checkpoints = Checkpoints(checkpoints.folder, recipe, label)
        return train(self.split, model, self.options, checkpoints=checkpoints, track=track)
