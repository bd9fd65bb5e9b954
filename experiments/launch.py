"""Start a program: settings in, one line and exit code 2 for wrong input.

Nothing slow is imported before Ctrl-C is handled: Hydra and JAX come later, when they are needed.
"""

import importlib
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable

from experiments.errors import leave, on_interrupt, one_line, unwind_on_sigterm, version
from experiments.settings import Program


def launch(program: Program, config: str = "config") -> None:
    """Call `program()(settings)` with the checked settings of conf/`config`.yaml and the command line."""
    with on_interrupt(leave), one_line():
        unwind_on_sigterm()
        sys.unraisablehook = keep_interrupt
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # names that the terminal cannot show cost no results
        if "--version" in sys.argv[1:]:
            print(version())
        elif {"--help", "-h"} & {*sys.argv[1:]}:
            from experiments import help_text

            print(help_text.help_text(config, sys.argv[1:]))
        else:
            warnings.filterwarnings("ignore", "A worker stopped")  # joblib renews a worker that has grown
            if not os.environ.get("MFVPR_CACHE"):  # empty is unset, or the cache would be the root of the file system
                os.environ.pop("MFVPR_CACHE", None)
            from experiments import command_line

            command_line.run(program, config)


def program(module: str, job: str) -> Callable[[], Callable[..., None]]:
    """A function that imports a job, so that --help and a wrong setting need not wait for JAX."""
    return lambda: getattr(importlib.import_module(f"experiments.{module}"), job)


def keep_interrupt(lost: "sys.UnraisableHookArgs") -> None:
    """Send Ctrl-C again if it was raised where no code can catch it, as in JAX's garbage collection callback."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        main = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, [main, signal.SIGINT]).start()
    else:
        sys.__unraisablehook__(lost)
