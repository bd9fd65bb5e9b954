"""Comparison of learned, hand-set and grid-searched scores, on queries that none of them was chosen on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.core.metrics import hits
from mfvpr.core.scorer import Scorer
from mfvpr.core.types import Shortlist
from mfvpr.core.weights import DescriptorDistanceWeight, FeatureScoreWeight, RatioWeight, UnitWeight
from mfvpr.evaluation.protocol import EvaluationProtocol, best_setting
from mfvpr.matchers.match_set import MatchSet
from mfvpr.tuning.learning.models import Model, Options, of_matches, start, train
from mfvpr.tuning.learning.splits import TrainingSplit, training_splits
from mfvpr.tuning.learning.training import Checkpoints, Fit
from mfvpr.tuning.sweeps.setting_rankings import FUSION, Setting, SweepOptions, rank_settings
from mfvpr.tuning.sweeps.setting_search import Axes, can_learn
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
    axes.check(match_set.image_sizes)
    options = options or Options()
    splits = training_splits(match_set, candidates, protocol, retrieval_score=options.retrieval_score)
    halves = [_HalfComparison(split, axes, options, checkpoints, runtime) for split in splits]
    return Comparison(protocol, match_set, candidates, [list(half.rows()) for half in halves])


@dataclass(frozen=True)
class _HalfComparison:
    """One half of `compare`; the other fields are its arguments."""

    split: TrainingSplit
    axes: Axes
    options: Options
    checkpoints: Checkpoints | None
    runtime: Runtime

    def rows(self) -> Iterator[Row]:
        """All scores, each evaluated as soon as it is chosen or learned."""
        scorer: Any = self.axes.scorer
        yield from self.by_hand("paper" if isinstance(scorer.weight, _OF_THE_PAPER) else "as set", scorer)
        yield from self.by_hand("1 - ratio", replace(scorer, weight=RatioWeight()))
        deviation = self.split.score_deviation(scorer)
        for fused in (False, True):
            name = "grid search" + " + retrieval" * fused
            setting, values = self.search(name, deviation, fused=fused)
            yield replace(self.evaluate(name, scorer, setting), values=values)
        for learned_weight in (False, True):
            for fused in (False, True):
                name = ("match weights" if learned_weight else "gradient") + " + retrieval" * fused
                model = start(self.split, scorer, self.options, fused=fused, learned_weight=learned_weight)
                fitted = self.learn(name, model)
                values = model.values(fitted.parameters)
                setting = {FUSION: values[FUSION]} if fused else {}
                row = self.evaluate(name, model.scorer_of(fitted.parameters), setting)
                yield replace(row, values=values, fitted=fitted)
        name, model = "match labels", of_matches(self.split, scorer, self.options)
        fitted = self.learn(name, model)
        for row in self.by_hand(name, model.scorer_of(fitted.parameters)):
            yield replace(row, fitted=fitted if row.name == name else None)  # both rows have the same training

    def by_hand(self, name: str, scorer: Scorer) -> Iterator[Row]:
        """The scorer alone, and fused with the retrieval by the c of the options."""
        yield self.evaluate(name, scorer, {})
        yield self.evaluate(f"{name} + retrieval", scorer, {FUSION: self.options.c})

    def evaluate(self, name: str, scorer: Scorer, setting: Setting) -> Row:
        """Evaluate a setting on the half to report on, with all candidates."""
        queries, protocol = self.split.half.report, self.split.protocol
        [first] = self.first_rows(name, scorer, [setting], queries, self.split.candidates.mask)
        by_threshold = [hits(first, positives.take(queries)) for positives in protocol.positives]
        return Row(self.split.name, name, np.stack(by_threshold), {}, None)

    def search(self, name: str, deviation: float, *, fused: bool) -> tuple[Setting, Mapping[str, Any]]:
        """The best setting of the grid on the half to choose on: as the sweep takes it, and as plain values."""
        axes = self.axes if fused else self.axes.without(FUSION)
        grid, queries, protocol = axes.grid(), self.split.half.tune, self.split.protocol
        settings = [{**axes.setting(plain)} for plain in grid]
        for setting in settings:
            if fused and FUSION not in setting:
                setting[FUSION] = self.options.c
            elif setting.get(FUSION) is not None:
                setting[FUSION] *= self.split.balance(deviation)  # in units of the scores
        rows = self.first_rows(name, axes.scorer, settings, queries, self.split.seen)
        recall = hits(rows, protocol.positives[protocol.main].take(queries)).mean(axis=-1)
        best = best_setting(recall, axes.values)
        return settings[best], grid[best]

    def first_rows(
        self, name: str, scorer: Scorer, settings: Sequence[Setting], queries: np.ndarray, seen: np.ndarray
    ) -> np.ndarray:
        """First rows `[S, q, 1]` of the rankings of the seen candidates by every setting."""
        runtime, label = self.runtime if len(settings) > 1 else DEFAULT_RUNTIME, f"{self.split.name}: {name}"
        options = SweepOptions((1,), self.options.ties, runtime=runtime, label=label)
        return rank_settings(scorer, settings, *self.split.part(queries), views=[seen[queries]], options=options)[0]

    def learn(self, name: str, model: Model) -> Fit:
        """Train a model, with checkpoints in the folder `half-name`."""
        checkpoints = self.checkpoints
        if checkpoints:
            folder_name = f"{self.split.name}-{name}".replace(" ", "_").replace("_+_", "_")
            recipe = {**checkpoints.recipe, "half": self.split.name, "model": name}
            checkpoints = Checkpoints(checkpoints.folder / folder_name, recipe)
        track = self.runtime.progress(f"{self.split.name}: {name}")
        return train(self.split, model, self.options, checkpoints=checkpoints, track=track)
