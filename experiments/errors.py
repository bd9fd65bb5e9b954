"""Wrong input and interruption, for every program: one line and an exit code, never a traceback."""

import argparse
import atexit
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from experiments.settings import SettingsError

if TYPE_CHECKING:  # it brings JAX along
    from mfvpr.checkpoints.registry import Entry

WEIGHTS = "python -m experiments.weights"
_INTERRUPTED = "\ninterrupted; nothing half-written was left, and what was finished is kept\n"


class Parser(argparse.ArgumentParser):
    """Of programs without settings."""

    def error(self, message: str) -> NoReturn:
        """Refuse wrong usage."""
        refuse(f"{message}; see {self.prog} --help")


def run_command(parser: Callable[[], argparse.ArgumentParser]) -> None:
    """Run the command that is typed: `run` among the parser's defaults, with all else that it gives."""
    unwind_on_sigterm()
    with one_line():
        arguments = vars(parser().parse_args())
        arguments.pop("run")(**arguments)


@contextmanager
def one_line() -> Iterator[None]:
    """Exit with 2 for wrong input, 130 for Ctrl-C, 141 for a reader who left; faults of our own pass through."""
    try:
        yield
    except KeyboardInterrupt:
        print(_INTERRUPTED, end="", file=sys.stderr)
        _unwound(130)
    except BrokenPipeError:  # whoever read our output has left: `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except SettingsError as error:
        refuse(str(error))
    except OSError as error:
        refuse(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except ValueError as error:
        from mfvpr.utils import InputError

        if not isinstance(error, InputError):
            raise
        refuse(with_command(error))


def with_command(error: Exception) -> str:
    """The message, and where weights are to be installed, how."""
    from mfvpr.checkpoints import WeightsError

    return f"{error}: {how_to_install(error.entry)}" if isinstance(error, WeightsError) else str(error)


def how_to_install(entry: "Entry") -> str:
    """The command that an installation of weights begins with."""
    command = f"convert {shlex.quote(entry.file)}" if entry.sha256 is None else f"download {entry.name}"
    return f"{WEIGHTS} {command}"


def refuse(reason: str) -> NoReturn:
    """One line on stderr, exit code 2."""
    print("error:", *reason.splitlines(), file=sys.stderr)
    sys.exit(2)


@contextmanager
def on_interrupt(answer: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Ctrl-C is answered so until the block ends."""
    before = signal.signal(signal.SIGINT, answer)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def leave(*_: object) -> NoReturn:
    """Of `on_interrupt` before anything is begun: an extension that is being imported could lose an exception."""
    os.write(2, _INTERRUPTED.encode())
    os._exit(130)


def unwind_on_sigterm() -> None:
    """Let SIGTERM unwind the stack, so that temporary files go."""
    signal.signal(signal.SIGTERM, lambda *_: _unwound(143))


def _unwound(code: int) -> NoReturn:
    """Exit where a computation of XLA's may be under way, which would abort an interpreter that ends around it."""
    atexit.register(leave_at_once, code)  # asked when the threads of Python's have been joined
    sys.exit(code)


def leave_at_once(code: int) -> NoReturn:
    """End the process without what else is to be done at its end."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # whoever read it has left
            stream.flush()
    os._exit(code)
