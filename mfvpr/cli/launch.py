"""Start a program: one line and an exit code for wrong input and interruption, never a traceback.

Nothing slow is imported before Ctrl-C is handled: Hydra and JAX come later, when they are needed.
"""

import argparse
import atexit
import io
import os
import pkgutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

from mfvpr.systems.settings import SettingsError

_INTERRUPTED = "\ninterrupted; nothing half-written was left, and what was finished is kept\n"


def launch(config: str) -> None:
    """Run the job of a program with the checked settings of conf/`config`.yaml and of the command line."""
    with on_interrupt(exit_interrupted), one_line():
        unwind_on_sigterm()
        sys.unraisablehook = resend_interrupt
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # names that the terminal cannot show cost no results
        if "--version" in sys.argv[1:]:
            print(version())
        elif {"--help", "-h"} & {*sys.argv[1:]}:
            from mfvpr.cli import help_text

            print(help_text.help_text(config, sys.argv[1:]))
        else:
            warnings.filterwarnings("ignore", "A worker stopped")  # joblib renews a worker that has grown
            for name in ("MFVPR_CACHE", "MFVPR_COMPILED"):  # empty is unset, or / would be the cache
                if not os.environ.get(name):
                    os.environ.pop(name, None)
            from mfvpr.cli import command_line

            command_line.run(config)


class Parser(argparse.ArgumentParser):
    """Command line of a program that has commands instead of settings."""

    def error(self, message: str) -> NoReturn:
        """Exit with one line for wrong usage."""
        refuse(f"{message}; see {self.prog} --help")


def run_command(prog: str, description: str, add_arguments: Callable[[Parser], None]) -> None:
    """Parse the command line, import the job that is the parser's default `run`, and call it with all arguments."""
    unwind_on_sigterm()
    with one_line():
        parser = Parser(prog=prog, description=description)
        parser.add_argument("--version", action="version", version=version(), help="print it and exit")
        add_arguments(parser)
        arguments = vars(parser.parse_args())
        import_job(arguments.pop("run"))(**arguments)


def import_job(path: str) -> Callable[..., None]:
    """Import the job `package.module:function`, which may import JAX; --help and wrong usage do without."""
    return pkgutil.resolve_name(path)


def version() -> str:
    """Versions of mfvpr, JAX and Python in one line."""
    from importlib.metadata import version

    from mfvpr import __version__

    return f"mfvpr {__version__} (jax {version('jax')}, Python {sys.version.split()[0]})"


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
        refuse(str(error))


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


def exit_interrupted(*_: object) -> NoReturn:
    """Exit on Ctrl-C without an exception, which a C extension that is being imported could lose."""
    os.write(2, _INTERRUPTED.encode())
    os._exit(130)


def resend_interrupt(lost: "sys.UnraisableHookArgs") -> None:
    """Send Ctrl-C again if it was raised where no code can catch it, as in JAX's garbage collection callback."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        main = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, [main, signal.SIGINT]).start()
    else:
        sys.__unraisablehook__(lost)


def unwind_on_sigterm() -> None:
    """Let SIGTERM unwind the stack, so that temporary files are removed."""
    signal.signal(signal.SIGTERM, lambda *_: _exit_after_threads(143))


def _exit_after_threads(code: int) -> NoReturn:
    """Exit where XLA may be computing, which would abort an interpreter that shuts down meanwhile."""
    atexit.register(exit_at_once, code)  # runs when Python's threads have been joined
    sys.exit(code)


def exit_at_once(code: int) -> NoReturn:
    """End the process without the other exit handlers."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # its reader may be gone
            stream.flush()
    os._exit(code)
