"""Notes, warnings, errors and progress of the programs, on stderr."""

import difflib
import os
import re
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn

from mfvpr.utils.errors import InputError

if TYPE_CHECKING:  # or the command line would wait for JAX
    from tqdm import tqdm

    from mfvpr.utils.runtime import Track

_ERASE = "\r\x1b[K"


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
            refuse(f"{reason.removesuffix('.')}; see --help")
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
    for rest in (" Config search path", " See https", " To append to your ", " object_type="):
        text = text.partition(rest)[0]
    if wrong := re.search(r"Could not find '(.*)/(.*)' Available options in '.*': (.*)", text):
        group, name, choices = wrong[1], wrong[2], wrong[3].split()
        nearest = "".join(f"; the nearest is {each}" for each in difflib.get_close_matches(name, choices, n=1))
        return f"{group}={name}: expected one of {', '.join(choices)}{nearest}"
    if wrong := re.search(r"Could not override '(.*?)'", text):
        return f"{wrong[1]}: unknown setting"
    if wrong := re.match(r"Missing mandatory value: .*full_key: (\S+)", text):
        return f"{wrong[1]}: expected a value, got none"
    return text


def refuse(reason: str) -> NoReturn:
    """Print one line on stderr and exit with code 2."""
    print("error:", *reason.encode(errors="backslashreplace").decode().splitlines(), file=sys.stderr)
    sys.exit(2)


def track(label: str) -> "Track":
    """Progress of a loop with the time left."""
    return lambda items, total: progress(label, items, total)


def progress(label: str, items: Iterable[Any] | None = None, total: int | None = None) -> "tqdm[Any]":
    """Progress with the time left, of loops of more than two seconds: a line that is overwritten in a terminal."""
    from tqdm import tqdm

    is_terminal = sys.stderr.isatty()
    interval = 0.1 if is_terminal else 10  # seconds between two lines
    return tqdm(items, label, total, leave=not is_terminal, mininterval=interval, miniters=1, delay=2)
