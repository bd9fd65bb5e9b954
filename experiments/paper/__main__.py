"""The paper's evaluation. `python -m experiments.paper --help`."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def paper() -> Callable[[dict[str, Any]], None]:
    """Every system on every data set, tables and figures."""
    from experiments.paper import program  # here, so that --help and a wrong setting need not wait for JAX

    return program.paper


if __name__ == "__main__":
    launch(paper, "paper")
