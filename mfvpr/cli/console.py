"""Notes, warnings and progress of the programs, on stderr."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

if TYPE_CHECKING:  # or the command line would wait for JAX
    from mfvpr.utils.progress import Track


def tell(text: str) -> None:
    """Print a line that is no result."""
    print(text, file=sys.stderr)


def track(label: str) -> "Track":
    """A progress bar with the time left."""
    return lambda items, total: bar(label, total, items)


def bar(label: str, total: int, items: Iterable[Any] | None = None) -> tqdm:
    """A progress bar in the look that all programs share; hidden if `total` is 0."""
    style = tqdm if sys.stderr.isatty() else _Lines
    return style(items, total=total, desc=f"{label:<20}", unit="", dynamic_ncols=True, disable=total == 0)


class _Lines(tqdm):
    """Progress in a file or a log: a line per 10 %, and one after the first item."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._shown = (-1, 0)
        super().__init__(*arguments, mininterval=0, miniters=1, leave=False, **options)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Print a line where tqdm would draw a bar."""
        tenths = 10 * self.n // self.total
        if (tenths, min(self.n, 1)) > self._shown:
            self._shown = tenths, min(self.n, 1)
            elapsed = self.format_dict["elapsed"]
            left = f", about {elapsed * (self.total - self.n) / self.n:.0f} s left" if 0 < self.n < self.total else ""
            tell(f"{self.desc} {10 * tenths:3d} %  {self.n} of {self.total}  {elapsed:.0f} s{left}")
