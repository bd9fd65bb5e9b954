"""Wrong input and interruption, for every program: one line and an exit code, never a traceback."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from experiments.settings import SettingsError


@contextmanager
def one_line() -> Iterator[None]:
    """Exit with 2 for wrong input, 130 for Ctrl-C, 141 for a reader who left; faults of our own pass through."""
    try:
        yield
    except KeyboardInterrupt:
        print("\ninterrupted; nothing half-written was left, and what was finished is kept", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # whoever read our output has left: `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except SettingsError as error:
        refuse(str(error))
    except OSError as error:
        refuse(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except ValueError as error:
        from mfvpr.errors import InputError  # here, since it brings JAX along

        if not isinstance(error, InputError):
            raise
        refuse(with_command(error))


def with_command(error: Exception) -> str:
    """The message, and where weights are to be installed, how."""
    from experiments.weights import how_to_install
    from mfvpr.weights.files import WeightsError

    return f"{error}: {how_to_install(error.entry)}" if isinstance(error, WeightsError) else str(error)


def refuse(reason: str) -> NoReturn:
    """One line on stderr, exit code 2."""
    print("error:", *reason.splitlines(), file=sys.stderr)
    sys.exit(2)


def unwind_on_sigterm() -> None:
    """Let SIGTERM unwind the stack, so that temporary files go."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
