"""Parameter sweeps: every setting of a grid on every query, the best of them, and how sure that is."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def sweep() -> Callable[[dict[str, Any]], None]:
    """The search, its table, a run folder."""
    from experiments import search  # here, so that --help and a wrong setting need not wait for JAX

    return search.sweep


if __name__ == "__main__":
    launch(sweep, "sweep")
