__all__ = [
    "Axes",
    "Outcome",
    "SweepOptions",
    "rank_settings",
    "search_grid",
    "search_optuna",
]

from .sweeps import Axes, Outcome, SweepOptions, rank_settings, search_grid, search_optuna
