"""Progress of long loops, and a stopwatch. A caller may wrap each loop, for instance in a progress bar."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]  # (items, their number) -> the same items


def no_progress(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items


@dataclass
class Stopwatch:
    """Seconds by stage. A stage excludes the stages inside it."""

    seconds: dict[str, float] = field(default_factory=dict)
    _inside: list[float] = field(default_factory=list, repr=False)  # seconds of other stages inside each open one

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        self._inside.append(0)
        try:
            yield
        finally:
            total, inside = time.perf_counter() - start, self._inside.pop()
            if self._inside:
                self._inside[-1] += total
            self.seconds[stage] = round(self.seconds.get(stage, 0) + total - inside, 3)
