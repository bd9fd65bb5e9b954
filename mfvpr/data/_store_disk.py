"""How a store of rows lies on disk: its arrays, its lock, and what goes wrong there, each told in one line."""

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore as ts

from mfvpr.errors import InputError

_DAMAGE = ("DATA_LOSS", "NOT_FOUND", "FAILED_PRECONDITION", "OUT_OF_RANGE", "INVALID_ARGUMENT")
BYTES = {"name": "bytes", "configuration": {"endian": "little"}}
ZSTD = {"name": "zstd", "configuration": {"level": 1}}


@dataclass(frozen=True)
class Column:
    """One array of a store; all of a row's are written before the row is done.

    Attributes:
        dtype: of its values; where rows have entries, floating point.
        shape: of a row's value; with `chunk`, of one entry.
        chunk: entries in a chunk, where rows have any number of entries; None = one value a row.
        capacity: the most entries of a row; chunks that are absent cost nothing.
        codecs: Zarr's, of chunks `[1, chunk, *shape]`; a checksum is added.
    """

    dtype: str
    shape: tuple[int, ...] = ()
    chunk: int | None = None
    capacity: int = 2**20
    codecs: tuple[Mapping[str, Any], ...] = (BYTES, ZSTD)


def open_arrays(
    folder: Path, num_rows: int, columns: Mapping[str, Column], context: ts.Context
) -> dict[str, ts.TensorStore]:
    """The arrays of `columns` and `count`, made where they are not there.

    Reading what was never written is an error, but for `count`.
    """
    arrays = {}
    for name, column in {**columns, "count": Column("int32")}.items():
        spec = {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(folder / name)},
            "metadata": _metadata(column, num_rows),
            "fill_missing_data_reads": name == "count",
            "store_data_equal_to_fill_value": name != "count",  # a chunk that is not there was never written
        }
        arrays[name] = ts.open(spec, context=context, open=True, create=True).result()
    return arrays


def _metadata(column: Column, num_rows: int) -> dict[str, Any]:
    entries, chunk = ((), ()) if column.chunk is None else ((column.capacity,), (column.chunk,))
    return {
        "shape": (num_rows, *entries, *column.shape),
        "data_type": column.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": (1, *chunk, *column.shape)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},  # no folder per row
        "fill_value": -1 if column.dtype == "int32" else "NaN",
        "codecs": [*column.codecs, {"name": "crc32c"}],
    }


def read_counts(array: ts.TensorStore) -> np.ndarray:
    """`[M]` int32; rows whose count is damaged are not done."""
    try:
        return np.array(array.read().result())
    except ValueError as error:
        if not is_damage(error):
            raise
    counts = np.full(array.shape, -1, np.int32)
    for row in range(len(counts)):
        try:
            counts[row] = array[row].read().result()
        except ValueError as error:
            if not is_damage(error):
                raise
            array[row].write(-1).result()
    return counts


def commit(writes: Sequence[ts.WriteFutures]) -> None:
    """Wait until all are on disk, or have failed: nothing may be written after an error was told."""
    if errors := [error for write in writes if (error := write.exception()) is not None]:
        raise errors[0]


@contextmanager
def locked(folder: Path, content: str, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the store's lock, which ends with the process, however that ends.

    Args:
        folder: the store's.
        content: what it holds.
        waiting: is told, in one line, whom this waits for; None = refuse a store that is in use.
    """
    with told(folder, content):
        handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        with told(folder, content):
            _take(handle, folder, waiting)
        with suppress(OSError):  # a full disk; the lock holds without its owner's name
            os.ftruncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
        try:
            yield
        finally:
            os.ftruncate(handle, 0)
    finally:
        os.close(handle)


def _take(handle: int, folder: Path, waiting: Callable[[str], None] | None) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(handle, 20, 0).decode(errors="replace") or "unknown"
        if waiting is None:
            raise InputError(f"{folder}: in use by process {holder}; wait until it ends, or stop it") from None
        waiting(f"{folder}: in use by process {holder}; waiting until it is free")
        fcntl.flock(handle, fcntl.LOCK_EX)


@contextmanager
def told(folder: Path, content: str, needed: int = 10**6) -> Iterator[None]:
    """What the file system or tensorstore raise, as one line.

    Args:
        folder: the store's.
        content: what it holds.
        needed: bytes that what is under way takes.
    """
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        if _is_disk_full(error):
            message = too_full(folder, needed, free_bytes(folder))
        elif is_damage(error):
            message = f"{folder}: damaged ({reason(error)}); delete this folder and run again"
        else:
            message = f"{folder}: cannot hold {content} ({reason(error)}); check the path, its permissions and its disk"
        raise InputError(message) from None


def is_damage(error: Exception) -> bool:
    return str(error).startswith(_DAMAGE)


def _is_disk_full(error: Exception) -> bool:
    codes = (errno.ENOSPC, errno.EDQUOT)
    number = error.errno if isinstance(error, OSError) else None
    return number in codes or any(f"os_error_code='{code}'" in str(error) for code in codes)


def reason(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.partition(" [")[0].split())[:300]  # tensorstore appends its whole specification


def free_bytes(folder: Path) -> int:
    folder = folder.absolute()
    return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free


def too_full(folder: Path, needed: int, free: int) -> str:
    return (
        f"{folder}: expected about {needed / 1e6:.1f} MB of free disk space, got {free / 1e6:.1f} MB; free some space "
        "and run again, which goes on from here"
    )
