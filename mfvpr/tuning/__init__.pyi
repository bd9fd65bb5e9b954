__all__ = [
    "Axes",
    "Outcome",
    "search_grid",
    "search_optuna",
    "sweep",
]

from .sweeps import Axes, Outcome, search_grid, search_optuna, sweep
