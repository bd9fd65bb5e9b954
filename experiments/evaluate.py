"""The main job: two folders of images in, a table of recall, rankings and figures out."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def evaluate() -> Callable[[dict[str, Any]], None]:
    """Every stage, the table, a run folder."""
    from experiments import evaluation  # here, so that --help and a wrong setting need not wait for JAX

    return evaluation.evaluate


if __name__ == "__main__":
    launch(evaluate)
