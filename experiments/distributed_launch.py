"""Tasks of one run that are at work at the same time and know of each other (`jax.distributed`): coordinator=HOST:PORT.

The filter then spreads over the devices of all of them, and a task waits for what the others make. Where one dies, XLA
aborts the rest, which no handler of Python's survives: so each task has a process that waits for it, and tells.
"""

import atexit
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from experiments.errors import leave_at_once
from experiments.settings import SettingsError

INTERRUPTED = 75  # EX_TEMPFAIL of sysexits.h: to be tried again
LOST_AFTER = 15  # seconds without a sign of life
_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_OF_A_TASK = "MFVPR_TASK"  # set in the process that works


@contextmanager
def met(settings: Mapping[str, Any], program: str, typed: Sequence[str]) -> Iterator[None]:
    """Around the work of a task: in the process that was started, wait for another that does it.

    Args:
        settings: of the task; without a coordinator nothing is done.
        program: that was started.
        typed: its settings as they were typed.
    """
    if not settings.get("coordinator"):
        yield
    elif _OF_A_TASK not in os.environ:
        sys.exit(_waited_for([sys.executable, "-m", f"experiments.{program}", *typed], settings))
    else:
        _join(settings)
        try:
            yield
        except Exception as error:
            _leave_without_the_others(2 if isinstance(error, SettingsError | ValueError | OSError) else 1)
            raise


def part() -> None:
    """The others are not needed any more."""
    import jax

    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _waited_for(command: list[str], settings: Mapping[str, Any]) -> int:
    """The exit code of a process, to which signals are passed on."""
    task = subprocess.Popen(command, env=os.environ | {_OF_A_TASK: "1"}, preexec_fn=_end_with_parent)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: task.send_signal(number) if number == signal.SIGTERM else None)
    code = task.wait()
    if code >= 0:
        return code
    if code == -signal.SIGABRT:
        print(f"error: shard={settings['shard']}: another task has ended, or cannot be reached (see {_log(settings)}); "
              "what was finished is kept: start all tasks again, which go on from there", file=sys.stderr)  # fmt: skip
        return INTERRUPTED
    return 128 - code


def _end_with_parent() -> None:
    """Of the process that works: no one who kills the other leaves it behind (Linux)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _join(settings: Mapping[str, Any]) -> None:
    import jax

    from mfvpr.storage import Shard

    shard = Shard.parse(settings["shard"])
    _keep_for_python(_log(settings))
    jax.distributed.initialize(
        settings["coordinator"], shard.count, shard.index, heartbeat_timeout_seconds=LOST_AFTER,
        initialization_timeout=max(60, int(settings["wait"])),
    )  # fmt: skip


def _log(settings: Mapping[str, Any]) -> Path:
    from experiments.sharding import task_folder

    return task_folder(settings) / "log"


def _keep_for_python(log: Path) -> None:
    """What libraries write by themselves, stack traces and all, goes into a file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for name, handle in (("stdout", 1), ("stderr", 2)):
        own = os.fdopen(os.dup(handle), "w", buffering=1, errors="backslashreplace")
        getattr(sys, name).flush()
        os.dup2(file, handle)
        setattr(sys, name, own)
    os.close(file)


def _leave_without_the_others(code: int) -> None:
    """At the end of this process, which JAX would keep until all others end as well."""
    atexit.register(leave_at_once, code)
