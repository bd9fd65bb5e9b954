"""Parameter sweeps: every setting of a grid on every query, the best of them, and how sure that is."""

from typing import Any

from experiments.launch import launch


def sweep(settings: dict[str, Any]) -> None:
    """Search, print the table, leave a run folder."""
    from experiments import search  # here, so that --help and a wrong setting need not wait for JAX

    search.sweep(settings)


if __name__ == "__main__":
    launch(sweep, "sweep")
