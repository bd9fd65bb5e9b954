"""Localize images in a map: a line of JSON for each. `python -m experiments.localize --help`."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def localize() -> Callable[[dict[str, Any]], None]:
    """The job, which is slow to import."""
    from experiments import localization

    return localization.localize


if __name__ == "__main__":
    launch(localize, "localize")
