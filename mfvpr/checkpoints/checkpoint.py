"""Read published checkpoints as plain data: of PyTorch in both formats, NumPy and MATLAB.

No code in a file is executed. A pickle may ask by name only for ordered dictionaries, tensors, parameters and the notes
of a training, which are skipped.
"""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal, NamedTuple

import numpy as np

from mfvpr.io.containers import reading, shorten
from mfvpr.io.object_files import (
    NUMPY_MAGIC,
    DataUnpickler,
    Function,
    open_torch_archive,
    read_matlab,
    read_objects,
)
from mfvpr.utils.errors import InputError

_LAYERS = "a dictionary of layers"


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Read arrays by key, in the file's own types.

    Keys are those of the tensors in PyTorch's files (below `model`, `state_dict` or `model_state_dict`, if nested),
    `layer.name` in NumPy's dictionaries of layers, and `variable.field.0` in MATLAB's structures and cells.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds other content.
    """
    path = Path(path)
    start = require_checkpoint(path)
    (read,) = (read for magic, read in _READERS.items() if start.startswith(magic))
    with reading(path, "a checkpoint file", "download it again"), path.open("rb") as file:
        return read(file)


def require_checkpoint(path: Path) -> bytes:
    """Read the first bytes; raise an InputError unless they are those of a checkpoint."""
    with reading(path, "a checkpoint file", "download it again"), path.open("rb") as file:
        start = file.read(64)
    if not start.startswith(tuple(_READERS)):
        kind = "an empty file" if not start else "a text file, perhaps a web page" if start.isascii() else "another"
        raise InputError(f"{path}: expected a checkpoint of torch, NumPy or MATLAB, got {kind}; download it again")
    return start


def _read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a .npy file with a pickled dictionary of layers."""
    [layers] = read_objects(file, _LAYERS)
    arrays = {}
    for layer, parts in layers.items():
        for name, array in parts.items():
            key = f"{layer}.{name}"
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
                raise InputError(f"expected arrays by layer, got {type(array).__name__} at {shorten(key)}")
            arrays[key] = array
    if not arrays:
        raise InputError(f"expected {_LAYERS}, got none; use the official file")
    return arrays


Order = Literal["little", "big"]

_WRAPPERS = ("model", "state_dict", "model_state_dict")
_ORDERS: dict[bytes, Order] = {b"little": "little", b"big": "big"}
_CODES = {  # NumPy's types of weights, then of counters
    "FloatStorage": "f4",
    "DoubleStorage": "f8",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001  # the start of files from before torch 1.6, which are not zip files


class _Storage(NamedTuple):
    """Values that tensors share."""

    code: str  # of their type in NumPy
    key: str
    count: int  # values


class _Tensor(NamedTuple):
    """A strided view of a storage; offset and strides count values."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Dictionary(dict):
    """An ordered dictionary; its attributes are skipped."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Note:
    """A note of a training: the command line and the losses, in checkpoints of D2-Net's training. It is skipped."""

    def __init__(self, *_: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        pass


_NOTES = ("_codecs.encode", "numpy.dtype", "numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")


class _TensorUnpickler(DataUnpickler):
    names: ClassVar[Mapping[str, Any]] = {
        "collections.OrderedDict": Function(_Dictionary),
        "torch._utils._rebuild_tensor_v2": Function(lambda *parts: _Tensor(*parts[:4])),
        "torch._utils._rebuild_parameter": Function(lambda tensor, *_: tensor),
        **dict.fromkeys(_NOTES, Function(_Note)),
        **{f"torch.{kind}": code for kind, code in _CODES.items()},
        **{f"torch.storage.{kind}": code for kind, code in _CODES.items()},
    }

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("argparse", "Namespace"):
            return type("Note", (_Note,), {})  # a class of its own, as a pickle makes and fills its instances
        return super().find_class(module, name)

    def persistent_load(self, pid: Any) -> _Storage:
        match pid:
            case ("storage", str(code), str(key), _, int(count), *rest) if rest in ([], [None]):
                return self.storages.setdefault(key, _Storage(code, key, count))
        raise InputError("expected plain dense tensors, got others; use the official file")


def _read_zip(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a zip file with the values of each storage."""
    with open_torch_archive(file) as (archive, folder, content):
        has_order = f"{folder}byteorder" in archive.namelist()
        order = _ORDERS[archive.read(f"{folder}byteorder") if has_order else b"little"]
        tensors = _TensorUnpickler(content).load()
        return _arrays(tensors, order, lambda storage: archive.read(f"{folder}data/{storage.key}"))


def _read_legacy(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read five pickles (two numbers, byte order, content, keys of the storages), then the values of each storage."""
    if (_TensorUnpickler(file).load(), _TensorUnpickler(file).load()) != (_MAGIC, _PROTOCOL):
        raise InputError("expected a torch checkpoint, got another pickle; use the official file")
    order: Order = "little" if _TensorUnpickler(file).load()["little_endian"] else "big"
    unpickler = _TensorUnpickler(file)
    content, keys = unpickler.load(), _TensorUnpickler(file).load()
    values = {}
    for key in keys:
        count = int.from_bytes(file.read(8), order)
        values[key] = file.read(count * np.dtype(unpickler.storages[key].code).itemsize)
    return _arrays(content, order, lambda storage: values[storage.key])


def _arrays(content: Any, order: Order, read_values: Callable[[_Storage], bytes]) -> dict[str, np.ndarray]:
    """Arrays of the tensors in a pickle's content; `order` is the byte order of their values."""

    @cache
    def values_of(storage: _Storage) -> np.ndarray:  # in native byte order, for all tensors that share it
        dtype = np.dtype(storage.code)
        values = np.frombuffer(read_values(storage), dtype.newbyteorder(order)).astype(dtype, copy=False)
        if len(values) != storage.count:
            raise ValueError("a storage of another size")
        return values

    if isinstance(content, dict):
        content = next((content[key] for key in _WRAPPERS if isinstance(content.get(key), dict)), content)
    if not isinstance(content, dict) or not content:
        raise InputError(f"expected tensors by name, got {type(content).__name__}; use the official file")
    arrays = {}
    for key, tensor in content.items():
        if not isinstance(key, str) or not isinstance(tensor, _Tensor):
            raise InputError(f"expected tensors by name, got {type(tensor).__name__} at {shorten(str(key))}")
        values = values_of(tensor.storage)
        strides = [step * values.itemsize for step in tensor.strides]
        offset = tensor.offset * values.itemsize
        arrays[key] = np.ndarray(tensor.shape, values.dtype, values, offset, strides)  # checks bounds
    return arrays


# First bytes of a file -> reader; every binary pickle begins with the last ones.
_READERS = {b"PK": _read_zip, NUMPY_MAGIC: _read_layers, b"MATLAB": read_matlab, b"\x80": _read_legacy}
