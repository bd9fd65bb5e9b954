"""Connect the tasks of one run that work at the same time (`jax.distributed`): coordinator=HOST:PORT.

Retrieval then uses the devices of all tasks, and a task waits for results of the others. If a task dies, XLA aborts all
others, and Python cannot handle that. So each task has a second process that waits for it and reports the error.
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

_INTERRUPTED = 75  # EX_TEMPFAIL of sysexits.h: try again
_LOST_AFTER = 15  # seconds without a heartbeat
_PR_SET_PDEATHSIG = 1  # of linux/prctl.h
_WORKER = "MFVPR_TASK"  # environment variable of the process that works


@contextmanager
def connection(settings: Mapping[str, Any], program: str, typed: Sequence[str]) -> Iterator[None]:
    """Connect a task to the others while it works, in a second process that the first one starts and waits for.

    Args:
        settings: settings of the task; without a coordinator there is nothing to do.
        program: name of the program that was started.
        typed: its settings as they were typed.
    """
    if not settings.get("coordinator"):
        yield
    elif _WORKER not in os.environ:
        sys.exit(_run_worker([sys.executable, "-m", f"experiments.{program}", *typed], settings))
    else:
        _join(settings)
        try:
            yield
        except Exception as error:
            code = 2 if isinstance(error, SettingsError | ValueError | OSError) else 1
            atexit.register(leave_at_once, code)  # JAX would keep the process until all others end as well
            raise


def disconnect() -> None:
    """End the connection to the other tasks."""
    import jax

    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _run_worker(command: list[str], settings: Mapping[str, Any]) -> int:
    """Run a command, forward signals to it, and return its exit code."""
    task = subprocess.Popen(command, env=os.environ | {_WORKER: "1"}, preexec_fn=_end_with_parent)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: task.send_signal(number) if number == signal.SIGTERM else None)
    code = task.wait()
    if code >= 0:
        return code
    if code == -signal.SIGABRT:
        print(f"error: shard={settings['shard']}: another task has ended, or cannot be reached (see {_log(settings)}); "
              "what was finished is kept: start all tasks again, which go on from there", file=sys.stderr)  # fmt: skip
        return _INTERRUPTED
    return 128 - code


def _end_with_parent() -> None:
    """Let Linux kill this process when the one that started it is killed."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _join(settings: Mapping[str, Any]) -> None:
    import jax

    from mfvpr.storage import Shard

    shard = Shard.parse(settings["shard"])
    _redirect_libraries(_log(settings))
    jax.distributed.initialize(
        settings["coordinator"], shard.count, shard.index, heartbeat_timeout_seconds=_LOST_AFTER,
        initialization_timeout=max(60, int(settings["wait"])),
    )  # fmt: skip


def _log(settings: Mapping[str, Any]) -> Path:
    from experiments.sharding import task_folder

    return task_folder(settings) / "log"


def _redirect_libraries(log: Path) -> None:
    """Write the stdout and stderr of C libraries into a file, but not those of Python."""
    log.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for name, handle in (("stdout", 1), ("stderr", 2)):
        python_stream = os.fdopen(os.dup(handle), "w", buffering=1, errors="backslashreplace")
        getattr(sys, name).flush()
        os.dup2(file, handle)
        setattr(sys, name, python_stream)
    os.close(file)
