"""Search of parameters of re-ranking over complete data sets, in compiled calls on cached matches."""

from mfvpr.tuning.sweeps.setting_rankings import DriveRanking, Setting, SweepOptions, grid, rank_settings
from mfvpr.tuning.sweeps.setting_search import Axes, Outcome, search_grid, search_optuna

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
