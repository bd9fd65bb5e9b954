"""Read PyTorch checkpoints of both formats as plain data, without PyTorch.

Only ordered dictionaries, tensors, parameters and the notes of a training may be called by name; notes are skipped.
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO, Literal

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.io.formats.pickles import MEND, DataUnpickler, Name, file_size, name_error, natural_number, of_type
from mfvpr.io.formats.torch_archives import open_torch_archive
from mfvpr.utils.errors import InputError

Order = Literal["little", "big"]

_WRAPPERS = ("model", "state_dict", "model_state_dict")
_ORDERS: dict[bytes, Order] = {b"little": "little", b"big": "big"}
_DTYPES = {  # types of weights, then of counters
    "FloatStorage": np.dtype("f4"), "DoubleStorage": np.dtype("f8"), "LongStorage": np.dtype("i8"),
    "IntStorage": np.dtype("i4"), "ShortStorage": np.dtype("i2"), "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"), "BoolStorage": np.dtype("?"),
}  # fmt: skip
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001  # the start of files from before torch 1.6, which are not zip files
_NOTES = {  # the command line and the losses, in checkpoints of D2-Net's training
    "argparse.Namespace", "_codecs.encode", "numpy.dtype",
    "numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar",
}  # fmt: skip


@dataclass(frozen=True)
class Storage:
    """Values that tensors share."""

    kind: str  # torch's name of its type: FloatStorage, ...
    key: str
    count: int  # values


@dataclass(frozen=True)
class Tensor:
    """A strided view of a storage; offset and strides count values."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class Unread:
    """A note of a training."""


class _TensorUnpickler(DataUnpickler):
    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.storages: dict[str, Storage] = {}

    def call(self, name: Name, arguments: tuple) -> Any:
        match str(name), arguments:
            case "collections.OrderedDict", ():
                return {}
            case "torch._utils._rebuild_tensor_v2", (Storage() as storage, offset, shape, strides, _, _):
                return Tensor(storage, natural_number(offset), _natural_numbers(shape), _natural_numbers(strides))
            case "torch._utils._rebuild_parameter", (Tensor() as tensor, _, _):
                return tensor
            case note, _ if note in _NOTES:
                return Unread()
        raise name_error(name, "plain dense tensors")

    def build(self, instance: Any, state: Any) -> None:
        """Skip the content of a note, and the attributes of an ordered dictionary."""
        if type(instance) not in (dict, Unread):
            raise TypeError("expected a note or an ordered dictionary")

    def persistent_load(self, pid: Any) -> Storage:
        match pid:
            case ("storage", Name("torch" | "torch.storage", kind), str(key), _, count, *rest):
                if rest not in ([], [None]):  # of older files: a view of another storage
                    raise InputError(f"expected plain dense tensors, got one in a part of another's storage; {MEND}")
                storage = Storage(kind, key, natural_number(count))
            case ("module", Name() as name, *_):
                raise name_error(name, "plain dense tensors")
            case _:
                raise TypeError("expected the identity of a storage")
        if self.storages.setdefault(key, storage) != storage:
            raise ValueError("two storages of one key")
        return storage


def _natural_numbers(values: Any) -> tuple[int, ...]:
    return tuple(natural_number(value) for value in of_type(tuple, values))


def read_zip(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a zip file with the values of each storage."""
    with open_torch_archive(file) as (archive, folder, pickle):
        has_order = f"{folder}byteorder" in archive.namelist()
        order = _ORDERS[archive.read(f"{folder}byteorder") if has_order else b"little"]
        content = _TensorUnpickler(pickle).load()
        return _arrays(content, order, lambda storage: archive.read(f"{folder}data/{storage.key}"))


def read_legacy(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read five pickles (two numbers, byte order, content, keys of the storages), then the values of each storage."""
    unpickler = _TensorUnpickler(file)
    if (unpickler.load(), unpickler.load()) != (_MAGIC, _PROTOCOL):
        raise InputError("expected a torch checkpoint, got another pickle; use the official file")
    order: Order = "little" if unpickler.load()["little_endian"] else "big"
    content, keys = unpickler.load(), unpickler.load()
    ranges = {}
    for key in keys:
        storage = unpickler.storages[key]
        size = storage.count * _dtype(storage).itemsize
        if int.from_bytes(file.read(8), order) != storage.count or file.tell() + size > file_size(file):
            raise ValueError("a storage of another size")
        ranges[key] = file.tell(), size
        file.seek(size, os.SEEK_CUR)
    if file.tell() != file_size(file):
        raise ValueError("bytes after the last storage")

    def read_values(storage: Storage) -> bytes:
        start, size = ranges[storage.key]
        file.seek(start)
        return file.read(size)

    return _arrays(content, order, read_values)


def _arrays(content: Any, order: Order, read_values: Callable[[Storage], bytes]) -> dict[str, np.ndarray]:
    """Arrays of the tensors in a pickle's content; `order` is the byte order of their values."""

    @cache
    def values_of(storage: Storage) -> np.ndarray:  # in native byte order, for all tensors that share it
        dtype = _dtype(storage)
        return np.frombuffer(read_values(storage), dtype.newbyteorder(order)).astype(dtype, copy=False)

    if isinstance(content, dict):
        content = next((content[key] for key in _WRAPPERS if isinstance(content.get(key), dict)), content)
    if not isinstance(content, dict) or not content:
        kind = "an empty dict" if content == {} else type(content).__name__
        raise InputError(f"expected tensors by name, got {kind}; use the official file")
    arrays = {}
    for key, tensor in content.items():
        if not isinstance(key, str):
            number = shorten(str(key))
            raise InputError(f"expected tensors by name, got one by the number {number}; use the official file")
        where = f" at {shorten(key)}"
        if not isinstance(tensor, Tensor):
            raise InputError(f"expected tensors only, got {type(tensor).__name__}{where}")
        dtype, values = _dtype(tensor.storage, where), values_of(tensor.storage)
        if len(values) != tensor.storage.count:
            raise ValueError("a storage of another size")
        if math.prod(tensor.shape) > tensor.storage.count:
            raise InputError(f"expected no more values than the file stores{where}; use the official file")
        strides = [step * dtype.itemsize for step in tensor.strides]
        arrays[key] = np.ndarray(tensor.shape, dtype, values, tensor.offset * dtype.itemsize, strides)  # checks bounds
    return arrays


def _dtype(storage: Storage, where: str = "") -> np.dtype:
    """Type of a storage's values; `where` ends the message of an error."""
    if storage.kind not in _DTYPES:
        kind = shorten(storage.kind.removesuffix("Storage"))
        raise InputError(f"expected tensors of float32 or float64, got {kind}{where}; use the official file")
    return _DTYPES[storage.kind]
