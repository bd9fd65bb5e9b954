"""Sweep parameters: the recall of every setting of a grid, the best setting, and its confidence interval."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def sweep() -> Callable[[dict[str, Any]], None]:
    """The job, which is slow to import."""
    from experiments import search

    return search.sweep


if __name__ == "__main__":
    launch(sweep, "sweep")
