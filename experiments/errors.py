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

if TYPE_CHECKING:  # it imports JAX
    from mfvpr.checkpoints.registry import Entry

WEIGHTS = "python -m experiments.weights"
_INTERRUPTED = "\ninterrupted; nothing half-written was left, and what was finished is kept\n"


class Parser(argparse.ArgumentParser):
    """Command line of a program that has commands instead of settings."""

    def error(self, message: str) -> NoReturn:
        """Exit with one line for wrong usage."""
        refuse(f"{message}; see {self.prog} --help")


def version() -> str:
    """Versions of mfvpr, JAX and Python in one line."""
    from importlib.metadata import version

    return f"mfvpr {version('mfvpr')} (jax {version('jax')}, Python {sys.version.split()[0]})"


def run_command(prog: str, description: str, add_arguments: Callable[[Parser], None]) -> None:
    """Parse the command line, import the parser's default `run`, and call it with all arguments."""
    unwind_on_sigterm()
    with one_line():
        parser = Parser(prog=prog, description=description)
        parser.add_argument("--version", action="version", version=version(), help="print it and exit")
        add_arguments(parser)
        arguments = vars(parser.parse_args())
        arguments.pop("run")()(**arguments)


@contextmanager
def one_line() -> Iterator[None]:
    """Exit with 2 for wrong input, 130 for Ctrl-C, 141 for a closed stdout; raise all other exceptions."""
    try:
        yield
    except KeyboardInterrupt:
        print(_INTERRUPTED, end="", file=sys.stderr)
        _exit_after_threads(130)
    except BrokenPipeError:  # as in `| head`
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
    """The message; for missing weights also the command that installs them."""
    from mfvpr.checkpoints import WeightsError

    return f"{error}: {how_to_install(error.entry)}" if isinstance(error, WeightsError) else str(error)


def how_to_install(entry: "Entry") -> str:
    """The first command that installs a checkpoint."""
    command = f"convert {shlex.quote(entry.file)}" if entry.sha256 is None else f"download {entry.name}"
    return f"{WEIGHTS} {command}"


def refuse(reason: str) -> NoReturn:
    """Print one line on stderr and exit with code 2."""
    print("error:", *reason.splitlines(), file=sys.stderr)
    sys.exit(2)


@contextmanager
def on_interrupt(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle Ctrl-C with `handler` until the block ends."""
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def leave(*_: object) -> NoReturn:
    """Exit on Ctrl-C without an exception, which a C extension that is being imported could lose."""
    os.write(2, _INTERRUPTED.encode())
    os._exit(130)


def unwind_on_sigterm() -> None:
    """Let SIGTERM unwind the stack, so that temporary files are removed."""
    signal.signal(signal.SIGTERM, lambda *_: _exit_after_threads(143))


def _exit_after_threads(code: int) -> NoReturn:
    """Exit where XLA may be computing, which would abort an interpreter that shuts down meanwhile."""
    atexit.register(leave_at_once, code)  # runs when Python's threads have been joined
    sys.exit(code)


def leave_at_once(code: int) -> NoReturn:
    """End the process without the other exit handlers."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # its reader may be gone
            stream.flush()
    os._exit(code)
