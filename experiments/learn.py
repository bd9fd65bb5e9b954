"""Learned scores beside hand-set and grid-searched ones, on queries that none of them was chosen on."""

from typing import Any

from experiments.launch import launch


def learn(settings: dict[str, Any]) -> None:
    """Learn, print the table, leave a run folder."""
    from experiments import lessons  # here, so that --help and a wrong setting need not wait for JAX

    lessons.learn(settings)


if __name__ == "__main__":
    launch(learn, "learn")
