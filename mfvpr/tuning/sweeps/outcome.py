"""What a sweep came to: the best setting, and what it is worth on queries that it was not chosen on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mfvpr import evaluation
from mfvpr.evaluation.protocol import Judge
from mfvpr.evaluation.statistics import Estimate, McNemar, SignFlips, block_sign_flips, estimate, mcnemar
from mfvpr.tuning.sweeps.axes import Axes


class Verdict(NamedTuple):
    """The chosen settings beside the scorer's own values, at one threshold.

    threshold: what counts as right.
    queries: that are reported on.
    chosen, own: recall at 1.
    mcnemar: whether they differ; the chosen ones are first.
    sign_flips: the same by blocks of the path.
    """

    threshold: float
    queries: int
    chosen: Estimate
    own: Estimate
    mcnemar: McNemar
    sign_flips: SignFlips


@dataclass(frozen=True)
class Outcome:
    """All rankings of a sweep, and what follows from them.

    Attributes:
        axes: what was varied.
        judge: what is right, with the views of the shortlist.
        settings: S plain ones; of a whole grid those come first, in its order.
        rows: `[V, S, Q, depth]` database rows, best first.
        ks: of the recall, ascending; none beyond the depth.
        is_grid: whether all settings of the grid are there.
    """

    axes: Axes
    judge: Judge
    settings: Sequence[Mapping[str, Any]]
    rows: np.ndarray
    ks: Sequence[int]
    is_grid: bool

    @cached_property
    def recall(self) -> np.ndarray:
        """`[S, thresholds]` at 1, of all queries."""
        return self.judge.recall(self.rows[0])

    @property
    def own(self) -> int:
        """The number of the scorer's own values."""
        return self.settings.index(dict(self.axes.own))

    @cached_property
    def chosen(self) -> list[int]:
        """The number of the best setting, for each half."""
        size = self.axes.size if self.is_grid else len(self.settings)
        axes = self.axes.values if self.is_grid else None
        tuning = self.judge.tuning(self.rows)
        return [evaluation.best_setting(recall[:size, self.judge.main], axes) for recall in tuning]

    @cached_property
    def report(self) -> list[Verdict]:
        """By threshold, of the queries that are reported on."""
        chosen = self.judge.reported(self.rows, self.chosen)
        own = self.judge.reported(self.rows, [self.own] * len(self.chosen))
        return [
            Verdict(
                threshold, len(first), estimate(first), estimate(second),
                mcnemar(first, second), block_sign_flips(first, second),
            )
            for threshold, first, second in zip(self.judge.thresholds, chosen, own, strict=True)
        ]  # fmt: skip
