"""The paper's evaluation: its systems, data sets, tables and figures, of whatever is at hand."""

from collections.abc import Callable
from typing import Any


def paper() -> Callable[[dict[str, Any]], None]:
    """Every system on every data set, tables and figures."""
    from experiments.paper import program  # here, so that --help and a wrong setting need not wait for JAX

    return program.paper
