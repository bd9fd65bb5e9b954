"""The lock of a store on disk, its size, and errors of the file system as one line."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mfvpr.utils.errors import InputError
from mfvpr.utils.locks import lock


@contextmanager
def lock_store(folder: Path, content: str, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock of a store; `waiting` gets a line if another process holds it, None = raise an `InputError`."""

    def on_conflict(handle: int) -> None:
        holder = os.pread(handle, 20, 0).decode(errors="replace") or "unknown"
        if waiting is None:
            raise InputError(f"{folder}: in use by process {holder}; wait until it ends, or stop it")
        waiting(f"{folder}: in use by process {holder}; waiting until it is free")

    with ExitStack() as stack:
        with disk_errors_as_input_errors(folder, content):
            handle = stack.enter_context(lock(folder / "lock", os.O_RDWR | os.O_CREAT, on_conflict))
        with suppress(OSError):  # a full disk; the lock holds without the number of its process
            os.ftruncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
        yield
        with suppress(OSError):
            os.ftruncate(handle, 0)


@contextmanager
def disk_errors_as_input_errors(
    folder: Path, content: str, needed: Callable[[], int] = lambda: 10**6
) -> Iterator[None]:
    """Raise errors of the file system as an InputError; `needed` gives the bytes that a full disk still has to hold."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise full_disk_error(folder, needed()) from None
        raise InputError(
            f"{folder}: cannot hold {content} ({error.strerror}); check the path, its permissions and its disk"
        ) from None


def used_bytes(folder: Path) -> int:
    """Bytes on disk of all files below a folder, except those that another process removes meanwhile."""
    total = 0
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            with suppress(FileNotFoundError):
                total += os.stat(os.path.join(parent, name)).st_blocks * 512
    return total


def free_disk_bytes(folder: Path) -> int:
    folder = folder.absolute()
    return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free


def full_disk_error(folder: Path, needed: int) -> InputError:
    free = free_disk_bytes(folder)
    return InputError(f"{folder}: expected about {needed / 1e6:.1f} MB of free disk space, got {free / 1e6:.1f} MB; "
                      "free some space and run again, which goes on from here")  # fmt: skip
