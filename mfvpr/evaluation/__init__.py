"""Rankings become recall: what is right, recall@K, and the protocol of choosing settings and reporting on them.

Intervals and tests of recall are in `mfvpr.evaluation.statistics`.
"""

from mfvpr.datasets.positives import Positives, frame_positives, radius_positives, rows_within
from mfvpr.datasets.truth import Truth, Unit, middle, threshold_words
from mfvpr.evaluation.protocol import Judge, Split, judge
from mfvpr.evaluation.recall import Tally, hits, recall_at_k
from mfvpr.evaluation.selection import Half, best_setting, halves, neighbors, separated

__all__ = ["Half", "Judge", "Positives", "Split", "Tally", "Truth", "Unit", "best_setting", "frame_positives", "halves",
           "hits", "judge", "middle", "neighbors", "radius_positives", "recall_at_k", "rows_within", "separated",
           "threshold_words"]  # fmt: skip
