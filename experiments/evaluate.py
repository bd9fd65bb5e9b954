"""Evaluate systems: two folders of images in, a table of recall, rankings and figures out."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def evaluate() -> Callable[[dict[str, Any]], None]:
    """The job, which is slow to import."""
    from experiments import evaluation

    return evaluation.evaluate


if __name__ == "__main__":
    launch(evaluate)
