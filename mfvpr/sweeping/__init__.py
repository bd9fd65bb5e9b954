"""Parameters of the re-ranking searched over whole data sets, in compiled calls on cached matches."""

from mfvpr.sweeping.settings import Setting, grid
from mfvpr.sweeping.sweep import block_bytes, result_bytes, sweep

__all__ = ["Setting", "block_bytes", "grid", "result_bytes", "sweep"]
