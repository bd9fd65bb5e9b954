"""Ask a map where images were taken: a line of JSON for each. `python -m experiments.localize --help`."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def localize() -> Callable[[dict[str, Any]], None]:
    """Answers as they come."""
    from experiments import localization  # here, so that --help and a wrong setting need not wait for JAX

    return localization.localize


if __name__ == "__main__":
    launch(localize, "localize")
