"""Notes, warnings, errors and progress of the programs, on stderr."""

import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

from mfvpr.utils.errors import InputError

if TYPE_CHECKING:  # or the command line would wait for JAX
    from mfvpr.utils.runtime import Track

_QUIET = 2.0  # seconds before anything is shown
_INTERVALS = {True: 0.1, False: 10.0}  # seconds between two lines in a terminal, and in a file
_ERASE = "\r\x1b[K"
_OTHER_NAMES = {"store": "cache", "fusion.filter_score": "fusion.retrieval_score"}  # of version 0.2.0


def tell(text: str) -> None:
    """Print a line that is no result."""
    print(_ERASE * sys.stderr.isatty() + text, file=sys.stderr)


def warn(text: str) -> None:
    """Print a warning."""
    tell(f"warning: {text}")


@contextmanager
def one_line() -> Iterator[None]:
    """Exit with 2 and one line for wrong input, with 130 for Ctrl-C, 141 for a closed stdout; a bug is a traceback."""
    try:
        yield
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C would interrupt the exit
        print("\ninterrupted; what was finished is kept", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except InputError as error:
        refuse(str(error))
    except Exception as error:
        if reason := explain(error):
            refuse(reason)
        if isinstance(error, OSError):
            refuse(f"{error.filename or 'input or output'}: {error.strerror or error}")
        raise


def explain(error: Exception) -> str | None:
    """Hydra's error in one line; None for another one."""
    from hydra.errors import HydraException  # here: its import is slow, and Ctrl-C must be handled before
    from omegaconf.errors import OmegaConfBaseException

    is_group = str(error).startswith("Config group override")  # Hydra's ValueError, of GROUP=null
    if not is_group and not isinstance(error, HydraException | OmegaConfBaseException):
        return None
    text = " ".join((str(error) or str(error.__cause__)).split())
    for rest in (" Config search path", " See https", " To append to your config", " object_type="):
        text = text.partition(rest)[0]
    new_names = [f"; its name is {new} now" for old, new in _OTHER_NAMES.items() if f"'{old}'" in text]
    return text + "".join(new_names)


def refuse(reason: str) -> NoReturn:
    """Print one line on stderr and exit with code 2."""
    print("error:", *reason.encode(errors="backslashreplace").decode().splitlines(), file=sys.stderr)
    sys.exit(2)


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
                self.reach(self.n + 1, self._total)

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        """Erase the line, or write the last one unless the loop was interrupted."""
        if self._is_terminal:
            sys.stderr.write(_ERASE)
        elif error is None and self.n and time.monotonic() - self._start >= _QUIET:
            tell(self._line())

    def reach(self, number: int, total: int) -> None:
        """Show that `number` of `total` items are done, if it is time."""
        self.n, self._total = number, total
        if (now := time.monotonic()) >= self._next and number != total:
            self._next = now + _INTERVALS[self._is_terminal]
            start, end = (_ERASE, "") if self._is_terminal else ("", "\n")
            print(start + self._line(), end=end, file=sys.stderr, flush=True)

    def _line(self) -> str:
        elapsed = time.monotonic() - self._start
        if not self._total:
            return f"{self._label:<20}        {self.n:,}  {elapsed:.0f} s"
        left = elapsed * (self._total - self.n) / max(self.n, 1)
        share = f"{100 * self.n // self._total:3d} %  {self.n:,} of {self._total:,}"
        return f"{self._label:<20} {share}  {elapsed:.0f} s" + f", about {left:.0f} s left" * (self.n < self._total)
