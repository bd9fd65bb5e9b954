"""Reads torch checkpoints, of both formats and without torch, as plain data: nothing in the file is executed."""

import io
import math
import os
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from mfvpr.errors import InputError
from mfvpr.weights.pickles import Storage, Tensor, excerpt, read_pickle

Order = Literal["little", "big"]

_WRAPPERS = ("model", "state_dict")
_ORDERS: dict[bytes, Order] = {b"little": "little", b"big": "big"}
_DTYPES = {
    "FloatStorage": np.dtype("f4"),
    "DoubleStorage": np.dtype("f8"),
    "LongStorage": np.dtype("i8"),  # this and the following hold counters
    "IntStorage": np.dtype("i4"),
    "ShortStorage": np.dtype("i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001  # with which files begin that are no zip, those before torch 1.6
_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile)


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Tensors by key, read-only, in the file's own types; those below `model` or `state_dict`, if nested.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds anything but float32, float64 and integer tensors.
    """
    path = Path(path)
    _check_file(path)
    try:
        with path.open("rb") as file:
            is_zip = file.read(2) == b"PK"
            file.seek(0)
            return _read_zip(file) if is_zip else _read_legacy(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise InputError(f"{path}: this checkpoint is damaged; download it again") from error


def _check_file(path: Path) -> None:
    """Refuse by its first bytes what is no checkpoint."""
    again = "download it again"
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise InputError(f"{path}: expected a checkpoint file, got {'a folder' if path.is_dir() else 'no plain file'}")
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: expected a checkpoint file, got: {error.strerror}") from error
    if not start:
        raise InputError(f"{path}: expected a checkpoint, got an empty file; {again}")
    if start.startswith(b"PK"):
        if not zipfile.is_zipfile(path):
            raise InputError(f"{path}: this checkpoint is truncated; {again}")
    elif not start.startswith(b"\x80"):  # the first byte of every binary pickle
        kind = "a text file, perhaps a web page" if start.isascii() and b"\0" not in start else "another kind of file"
        raise InputError(f"{path}: expected a torch checkpoint, got {kind}; {again}")


def _read_zip(file: BinaryIO) -> dict[str, np.ndarray]:
    """A pickle, and one entry for the values of each storage; uncompressed, with checksums."""
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        packed = any(entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 for entry in entries)
        if packed or len(set(names)) < len(names) or sum(entry.file_size for entry in entries) > _size(file):
            raise InputError("expected each entry of the zip file once and uncompressed; use the official file")
        if broken := archive.testzip():
            raise InputError(f"this checkpoint is damaged, by the checksum of {excerpt(broken)}; download it again")
        (pickle,) = (name for name in names if name.split("/")[1:] == ["data.pkl"])
        folder = pickle.removesuffix("data.pkl")
        order = _ORDERS[archive.read(f"{folder}byteorder") if f"{folder}byteorder" in names else b"little"]
        content = read_pickle(io.BytesIO(archive.read(pickle)))
        return _arrays(content.value, order, lambda storage: archive.read(f"{folder}data/{storage.key}"))


def _read_legacy(file: BinaryIO) -> dict[str, np.ndarray]:
    """Five pickles: two numbers, the byte order, the content, the keys of its storages; then their values."""
    if (read_pickle(file).value, read_pickle(file).value) != (_MAGIC, _PROTOCOL):
        raise InputError("expected a torch checkpoint, got another pickle; use the official file")
    order: Order = "little" if read_pickle(file).value["little_endian"] else "big"
    content, keys = read_pickle(file), read_pickle(file).value
    places = {}
    for key in keys:
        storage = content.storages[key]
        size = storage.count * _dtype(storage).itemsize
        if int.from_bytes(file.read(8), order) != storage.count or file.tell() + size > _size(file):
            raise ValueError
        places[key] = file.tell(), size
        file.seek(size, os.SEEK_CUR)
    if file.tell() != _size(file):
        raise ValueError

    def values(storage: Storage) -> bytes:
        place, size = places[storage.key]
        file.seek(place)
        return file.read(size)

    return _arrays(content.value, order, values)


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def _arrays(content: Any, order: Order, values: Callable[[Storage], bytes]) -> dict[str, np.ndarray]:
    """Tensors of a pickle's content as arrays; `order` is that of their bytes."""
    values = cache(values)
    for key in _WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
            break
    if not isinstance(content, dict) or not content:
        kind = "an empty dict" if content == {} else type(content).__name__
        raise InputError(f"expected tensors by name, got {kind}; use the official file")
    arrays = {}
    for key, tensor in content.items():
        if not isinstance(key, str):
            number = excerpt(str(key))
            raise InputError(f"expected tensors by name, got one by the number {number}; use the official file")
        where = f" at {excerpt(key)}"
        if not isinstance(tensor, Tensor):
            raise InputError(f"expected tensors only, got {type(tensor).__name__}{where}")
        dtype = _dtype(tensor.storage, where).newbyteorder(order)
        raw = values(tensor.storage)
        if len(raw) != tensor.storage.count * dtype.itemsize:
            raise ValueError
        if math.prod(tensor.shape) > tensor.storage.count:
            raise InputError(f"expected no more values than the file stores{where}; use the official file")
        strides = [step * dtype.itemsize for step in tensor.strides]
        view = np.ndarray(tensor.shape, dtype, raw, tensor.offset * dtype.itemsize, strides)  # checks its bounds
        arrays[key] = view.astype(dtype.newbyteorder("="), copy=False)
    return arrays


def _dtype(storage: Storage, where: str = "") -> np.dtype:
    """Of a storage's values; `where` ends the message.

    Raises:
        InputError: neither float32 nor float64 nor an integer.
    """
    if storage.kind not in _DTYPES:
        kind = excerpt(storage.kind.removesuffix("Storage"))
        raise InputError(f"expected tensors of float32 or float64, got {kind}{where}; use the official file")
    return _DTYPES[storage.kind]
