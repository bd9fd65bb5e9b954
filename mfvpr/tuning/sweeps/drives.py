"""Rankings of whole drives in a sweep."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from mfvpr.datasets.datasets import Dataset
from mfvpr.datasets.positives import Positives
from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.selection import Half
from mfvpr.evaluation.sequences import DriveFilter


@dataclass(frozen=True)
class DriveRanking:
    """A drive filter for the queries of a sweep, and what it needs of their data set.

    `halves` are those that the views after the first are of: of a half, only the queries to choose on are ranked, among
    the rows that choosing may see.
    """

    drive_filter: DriveFilter
    num_rows: int
    excluded: Positives | None = None
    halves: Sequence[Half] = ()

    @classmethod
    def of(cls, drive_filter: DriveFilter, dataset: Dataset, protocol: EvaluationProtocol) -> "DriveRanking":
        """A filter for the only sequence of a data set."""
        return cls(drive_filter, len(dataset.database), dataset.only.excluded, protocol.halves)

    def rows(self, ranked: Ranked, view: int) -> Int[np.ndarray, "queries candidates"]:
        """Rows of a view's rankings, -1 where none are ranked."""
        excluded = None if self.excluded is None else self.excluded.dense()
        if not view:
            return self.drive_filter(ranked, self.num_rows, excluded).rows
        half, rows = self.halves[view - 1], np.full_like(ranked.rows, -1)
        unseen = np.broadcast_to(~half.allowed, (len(half.tune), self.num_rows))
        unseen = unseen if excluded is None else unseen | excluded[half.tune]
        tuned = Ranked(ranked.rows[half.tune], ranked.scores[half.tune])
        ranking = self.drive_filter(tuned, self.num_rows, unseen).rows
        rows[half.tune, : ranking.shape[1]] = ranking
        return rows
