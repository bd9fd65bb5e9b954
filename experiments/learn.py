"""Learn scores, and compare them with hand-set and grid-searched ones on other queries."""

from collections.abc import Callable
from typing import Any

from experiments.launch import launch


def learn() -> Callable[[dict[str, Any]], None]:
    """The job, which is slow to import."""
    from experiments import learning

    return learning.learn


if __name__ == "__main__":
    launch(learn, "learn")
