"""Notes, warnings and progress of the programs, on stderr."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # or the command line would wait for JAX
    from mfvpr.utils.progress import Track

_QUIET = 2.0  # seconds before anything is shown
_INTERVALS = {True: 0.1, False: 10.0}  # seconds between two lines in a terminal, and in a file
_ERASE = "\r\x1b[K"


def tell(text: str) -> None:
    """Print a line that is no result."""
    print(_ERASE * sys.stderr.isatty() + text, file=sys.stderr)


def track(label: str) -> "Track":
    """Progress with the time left."""
    return lambda items, total: Progress(label, total, items)


class Progress:
    """Progress of a loop with the time left: one line that a terminal overwrites, elsewhere a line per 10 s.

    Loops of less than 2 s show nothing.
    """

    def __init__(self, label: str, total: int, items: Iterable[Any] = ()) -> None:
        """`total` is 0 if it is not known."""
        self._label, self._total, self._items, self.n = label, total, items, 0
        self._is_terminal, self._start = sys.stderr.isatty(), time.monotonic()
        self._next = self._start + _QUIET

    def __iter__(self) -> Iterator[Any]:
        with self:
            for item in self._items:
                yield item
                self.update()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        """Erase the line, or write the last one."""
        if self._is_terminal:
            sys.stderr.write(_ERASE)
        elif self.n and time.monotonic() - self._start >= _QUIET:
            tell(self._line())

    def update(self, number: int = 1) -> None:
        """Count items, and show the progress if it is time."""
        self.reach(self.n + number, self._total)

    def reach(self, number: int, total: int) -> None:
        """Show that `number` of `total` items are done, if it is time."""
        self.n, self._total = number, total
        if (now := time.monotonic()) >= self._next and self.n != self._total:
            self._next = now + _INTERVALS[self._is_terminal]
            start, end = (_ERASE, "") if self._is_terminal else ("", "\n")
            print(start + self._line(), end=end, file=sys.stderr, flush=True)

    def _line(self) -> str:
        elapsed, counts = time.monotonic() - self._start, f"{self.n:,}"
        if not self._total:
            return f"{self._label:<20}        {counts}  {elapsed:.0f} s"
        left = elapsed * (self._total - self.n) / max(self.n, 1)
        share = f"{100 * self.n // self._total:3d} %  {counts} of {self._total:,}"
        return f"{self._label:<20} {share}  {elapsed:.0f} s" + f", about {left:.0f} s left" * (self.n < self._total)
