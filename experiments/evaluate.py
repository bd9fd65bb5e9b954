"""The main job: two folders of images in, a table of recall, rankings and figures out."""

from typing import Any

from experiments.launch import launch


def evaluate(settings: dict[str, Any]) -> None:
    """Run every stage, print the table, leave a run folder."""
    from experiments import run  # here, so that --help and a wrong setting need not wait for JAX

    run.evaluate(settings)


if __name__ == "__main__":
    launch(evaluate)
