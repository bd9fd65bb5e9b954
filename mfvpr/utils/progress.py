"""How far a long work is: whoever calls may wrap what is iterated over, in a progress bar for instance."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]  # of items, and how many there are


def untracked(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items


@dataclass
class Stopwatch:
    """Seconds by stage. A stage inside another one counts only for itself."""

    seconds: dict[str, float] = field(default_factory=dict)
    _inside: list[float] = field(default_factory=list, repr=False)  # seconds of other stages inside each open one

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        self._inside.append(0)
        try:
            yield
        finally:
            spent, inside = time.perf_counter() - start, self._inside.pop()
            if self._inside:
                self._inside[-1] += spent
            self.seconds[stage] = round(self.seconds.get(stage, 0) + spent - inside, 3)
