"""Locks of files and folders by `flock` of a handle: they end with their process, and hold within one, too."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path


@contextmanager
def lock(path: Path, flags: int, on_conflict: Callable[[int], None]) -> Iterator[int]:
    """Open a file or folder with the flags of `os.open`, and hold its lock; yields the handle.

    If the lock is held elsewhere, `on_conflict` is called with the handle: it raises, or returns to wait for the lock.
    """
    handle = os.open(path, flags, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_conflict(handle)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield handle
    finally:
        os.close(handle)


def lock_folder(folder: Path, error: Exception) -> AbstractContextManager[int]:
    """Hold the lock of an existing folder, without a file in it; raises `error` when it is held elsewhere."""

    def refuse(_: int) -> None:
        raise error

    return lock(folder, os.O_RDONLY | os.O_DIRECTORY, refuse)
