"""The result of a sweep: the best setting, and its recall on queries that it was not chosen on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mfvpr import evaluation
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.statistics import Estimate, McNemar, SignFlips, block_sign_flips, estimate, mcnemar
from mfvpr.tuning.sweeps.axes import Axes


class Verdict(NamedTuple):
    """Comparison of the recall@1 of the chosen settings with the scorer's own values, at one threshold.

    queries: number of queries that are reported on.
    mcnemar: test of their difference; the chosen settings are first.
    sign_flips: the same test by blocks of the path.
    """

    threshold: float
    queries: int
    chosen: Estimate
    own: Estimate
    mcnemar: McNemar
    sign_flips: SignFlips


@dataclass(frozen=True)
class Outcome:
    """All rankings of a sweep, and their evaluation.

    Attributes:
        protocol: the ground truth, with the views of the shortlist.
        settings: in plain values; those of a complete grid come first, in its order.
        rows: of the database, best first.
        ks: depths of the recall, ascending, up to the depth of `rows`.
        is_grid: whether `settings` has all settings of the grid.
    """

    axes: Axes
    protocol: EvaluationProtocol
    settings: Sequence[Mapping[str, Any]]
    rows: Int[np.ndarray, "views settings queries depth"]
    ks: Sequence[int]
    is_grid: bool

    @cached_property
    def recall(self) -> Float[np.ndarray, "settings tolerances"]:
        """Recall@1 over all queries."""
        return self.protocol.recall(self.rows[0])

    @property
    def own(self) -> int:
        """Number of the setting with the scorer's own values."""
        return self.settings.index(dict(self.axes.own))

    @cached_property
    def _tuning(self) -> Float[np.ndarray, "halves settings"]:
        """Recall@1 on the queries to choose on, of the settings that may be chosen."""
        size = self.axes.size if self.is_grid else len(self.settings)
        return self.protocol.tuning(self.rows)[:, :size, self.protocol.main]

    def _choose(self, recall: Float[np.ndarray, " settings"]) -> int:
        return evaluation.best_setting(recall, self.axes.values if self.is_grid else None)

    @cached_property
    def chosen(self) -> list[int]:
        """Number of the best setting, for each half."""
        return list(map(self._choose, self._tuning))

    @cached_property
    def best(self) -> int:
        """Number of the best setting by the mean recall of the halves."""
        return self._choose(self._tuning.mean(axis=0))

    @cached_property
    def report(self) -> list[Verdict]:
        """Verdicts by threshold, on the queries to report on."""
        chosen_hits = self.protocol.reported_hits(self.rows, self.chosen)
        own_hits = self.protocol.reported_hits(self.rows, [self.own] * len(self.chosen))
        return [
            Verdict(
                threshold, len(first), estimate(first), estimate(second),
                mcnemar(first, second), block_sign_flips(first, second),
            )
            for threshold, first, second in zip(self.protocol.thresholds, chosen_hits, own_hits, strict=True)
        ]  # fmt: skip
