"""Search of parameters of re-ranking over complete data sets, in compiled calls on cached matches."""

from mfvpr.tuning.sweeps.setting_groups import Setting, grid
from mfvpr.tuning.sweeps.setting_rankings import DriveRanking, SweepOptions, rank_settings
from mfvpr.tuning.sweeps.setting_search import Outcome, search_grid, search_optuna
from mfvpr.tuning.sweeps.sweep_axes import Axes

__all__ = [
    "Axes",
    "DriveRanking",
    "Outcome",
    "Setting",
    "SweepOptions",
    "grid",
    "rank_settings",
    "search_grid",
    "search_optuna",
]
