"""How far a long work is: whoever calls may wrap what is iterated over, in a progress bar for instance."""

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]  # of items, and how many there are


def untracked(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items
