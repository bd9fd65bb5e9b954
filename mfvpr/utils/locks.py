"""Locks of folders by `flock`, without a file in them: they end with their process, and hold within one, too."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def lock_folder(folder: Path, error: Exception | None) -> Iterator[None]:
    """Hold the lock of an existing folder; if it is held elsewhere, raise the error, or wait for it without one."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if error is None:
            fcntl.flock(handle, fcntl.LOCK_EX)
        else:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise error from None
        yield
    finally:
        os.close(handle)
