"""Search of parameters of re-ranking over complete data sets, in compiled calls on cached matches."""

from mfvpr.tuning.sweeps.axes import Axes
from mfvpr.tuning.sweeps.rankings import SweepOptions, rank_settings
from mfvpr.tuning.sweeps.search import Outcome, search_grid, search_optuna
from mfvpr.tuning.sweeps.settings import Setting, grid

__all__ = ["Axes", "Outcome", "Setting", "SweepOptions", "grid", "rank_settings", "search_grid",
           "search_optuna"]  # fmt: skip
