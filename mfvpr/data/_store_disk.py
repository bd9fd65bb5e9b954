"""How a feature store lies on disk: its arrays, its lock, and what goes wrong there, each told in one line."""

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore as ts

from mfvpr.errors import InputError

CHUNK_ROWS = 1024  # features; one chunk of descriptors is 1 MB at D = 512
MAX_FEATURES = 2**20  # of one image; absent chunks cost nothing
_DAMAGE = ("DATA_LOSS", "NOT_FOUND", "FAILED_PRECONDITION", "OUT_OF_RANGE", "INVALID_ARGUMENT")


def open_arrays(folder: Path, num_images: int, dimension: int, context: ts.Context) -> dict[str, ts.TensorStore]:
    """The arrays, made where they are not there. Reading what was never written is an error, but for `count`."""
    rows, chunk = (num_images, MAX_FEATURES), (1, CHUNK_ROWS)
    layout = {
        "descriptors": ("float16", (*rows, dimension), (*chunk, dimension)),
        "keypoints": ("float32", (*rows, 2), (*chunk, 2)),
        "scores": ("float32", rows, chunk),
        "image_size": ("float32", (num_images, 2), (1, 2)),
        "count": ("int32", (num_images,), (1,)),
    }
    arrays = {}
    for name, (dtype, shape, chunk_shape) in layout.items():
        spec = {
            "driver": "zarr3",
            "kvstore": {"driver": "file", "path": str(folder / name)},
            "metadata": _metadata(dtype, shape, chunk_shape),
            "fill_missing_data_reads": name == "count",
        }
        arrays[name] = ts.open(spec, context=context, open=True, create=True).result()
    return arrays


def _metadata(dtype: str, shape: Sequence[int], chunk_shape: Sequence[int]) -> dict[str, Any]:
    return {
        "shape": shape,
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk_shape}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},  # no folder per image
        "fill_value": -1 if dtype == "int32" else "NaN",  # which no feature is: a chunk of features is always written
        "codecs": [
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "zstd", "configuration": {"level": 1}},
            {"name": "crc32c"},
        ],
    }


def stored_dimension(folder: Path) -> int:
    path = folder / "descriptors" / "zarr.json"
    try:
        return int(json.loads(path.read_bytes())["shape"][2])
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{path}: damaged; delete {folder} and run again") from None


def read_counts(array: ts.TensorStore) -> np.ndarray:
    """`[M]` int32; images whose count is damaged are not done."""
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
def locked(folder: Path) -> Iterator[None]:
    """Hold the store's lock, which ends with the process, however that ends."""
    with told(folder):
        handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        with told(folder):
            _take(handle, folder)
        with suppress(OSError):  # a full disk; the lock holds without its owner's name
            os.ftruncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
        try:
            yield
        finally:
            os.ftruncate(handle, 0)
    finally:
        os.close(handle)


def _take(handle: int, folder: Path) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(handle, 20).decode(errors="replace") or "unknown"
        raise InputError(f"{folder}: in use by process {holder}; wait until it ends, or stop it") from None


@contextmanager
def told(folder: Path, needed: int = 10**6) -> Iterator[None]:
    """What the file system or tensorstore raise, as one line. `needed`: bytes that what is under way takes."""
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
            message = f"{folder}: cannot hold features ({reason(error)}); check the path, its permissions and its disk"
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
