"""Learned scores beside hand-set and grid-searched ones, on queries that none of them was chosen on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mfvpr.evaluation.protocol import Judge
from mfvpr.evaluation.recall import hits
from mfvpr.evaluation.selection import best_setting
from mfvpr.matching.match_set import MatchSet
from mfvpr.scoring.scorer import Scorer
from mfvpr.scoring.weights import DescriptorDistanceWeight, FeatureScoreWeight, RatioWeight, UnitWeight
from mfvpr.tuning.learning.models import Model
from mfvpr.tuning.learning.parameters import can_learn
from mfvpr.tuning.learning.splits import TrainingSplit, training_splits
from mfvpr.tuning.learning.teaching import Options, of_matches, start, train
from mfvpr.tuning.learning.training import Fit
from mfvpr.tuning.sweeps.axes import Axes
from mfvpr.tuning.sweeps.search import Stages, untracked_stages
from mfvpr.tuning.sweeps.settings import FUSION, Setting
from mfvpr.tuning.sweeps.sweep import sweep
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.progress import untracked

_OF_THE_PAPER = (FeatureScoreWeight, DescriptorDistanceWeight, UnitWeight)


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
    """The scorer as it is, weighted by the ratio, the best of the grid, and what gradients find: each alone and fused.

    Everything is chosen or learned on one half of the path, and reported on the other; or on some data sets and
    reported on others, see `mfvpr.tuning.learning.data_sets`. Gradients go through the ranking: "gradient" learns the
    scorer's numbers, "match weights" the weights as well; "match labels" learns weights from the matches of right pairs
    that agree with the dominant shift, and all others.

    Args:
        axes: the scorer, and the grid to search; an axis `c` is in units of the c that balances filter and score.
        judge: what is right, with halves.
        match_set: matches of Q queries with C candidates, with their ratio.
        candidates: their shortlist.
        options: how to learn.
        checkpoints: where a training that was interrupted goes on; None = nowhere.
        track: progress.

    Raises:
        InputError: the scorer has nothing to learn or no match weight, a setting cannot be scored, a half has too few
            queries, or the checkpoints are of something else.
        TrainingError: a loss is not finite.
    """
    if not can_learn(axes.scorer) or not hasattr(axes.scorer, "weight"):
        raise InputError(f"{type(axes.scorer).__name__}: expected a scorer with numbers to learn and a match weight")
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
        own: Any = self.axes.scorer
        yield from self.by_hand("paper" if isinstance(own.weight, _OF_THE_PAPER) else "as set", own)
        yield from self.by_hand("1 - ratio", replace(own, weight=RatioWeight()))
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
        name, model = "match labels", of_matches(self.split, own, self.options)
        fitted = self.learned(name, model)
        for row in self.by_hand(name, model.scorer_of(fitted.parameters)):
            yield replace(row, fitted=fitted if row.name == name else None)  # fused by hand it is the same

    def by_hand(self, name: str, scorer: Scorer) -> Iterator[Row]:
        """Alone, and fused with the filter's weight that is set by hand."""
        yield self.reported(name, scorer, {})
        yield self.reported(f"{name} + filter", scorer, {FUSION: self.options.c})

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
