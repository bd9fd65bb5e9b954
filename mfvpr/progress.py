"""How far a stage is, for whoever wants to see it: `track` wraps the iterable of a stage."""

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]  # of the items, and how many there are


def untracked(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items
