"""Parameters of the re-ranking searched over whole data sets, in compiled calls on cached matches."""

from mfvpr.sweeping.axes import Axes
from mfvpr.sweeping.outcome import Outcome
from mfvpr.sweeping.search import search_grid, search_optuna
from mfvpr.sweeping.settings import Setting, grid
from mfvpr.sweeping.sweep import result_bytes, sweep

__all__ = ["Axes", "Outcome", "Setting", "grid", "result_bytes", "search_grid", "search_optuna",
           "sweep"]  # fmt: skip
