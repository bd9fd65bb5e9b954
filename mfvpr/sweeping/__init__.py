"""Parameters of the re-ranking searched over whole data sets, in compiled calls on cached matches."""

from mfvpr.sweeping.choosing import Half, best_setting, halves, hits, neighbors, separated
from mfvpr.sweeping.settings import Setting, grid
from mfvpr.sweeping.sweep import block_bytes, result_bytes, sweep

__all__ = ["Half", "Setting", "best_setting", "block_bytes", "grid", "halves", "hits", "neighbors", "result_bytes",
           "separated", "sweep"]  # fmt: skip
