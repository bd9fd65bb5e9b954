"""Learned scores beside hand-set and grid-searched ones, on queries that none of them was chosen on."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def learn() -> Callable[[dict[str, Any]], None]:
    """Learning, its table, a run folder."""
    from experiments import learning  # here, so that --help and a wrong setting need not wait for JAX

    return learning.learn


if __name__ == "__main__":
    launch(learn, "learn")
