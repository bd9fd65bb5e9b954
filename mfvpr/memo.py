"""What was computed in this process and need not be computed again."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

Value = TypeVar("Value")


class Memo:
    """Values by name and by what they were computed from, which lives as long, for its identity tells it apart.

    Extractors and filters of one's own may have no hash, or arrays for which there is no `==`; names, and what else is
    given as `equal`, are compared as usual.
    """

    def __init__(self) -> None:
        self._values: dict[Hashable, tuple[Any, Any]] = {}

    def once(self, name: str, compute: Callable[[], Value], *identical: Any, equal: Hashable = None) -> Value:
        """The value of `compute`, which is called the first time only."""
        key = name, equal, *(id(part) for part in identical)
        if key not in self._values:
            self._values[key] = compute(), identical
        return self._values[key][0]
