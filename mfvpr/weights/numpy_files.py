"""Reads the one kind of .npy file that holds a network: layers by name, of arrays by name, pickled, as plain data.

NumPy itself executes what such a file asks for. Here arrays of numbers are known by their names, all else is refused.
"""

import math
import re
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from mfvpr.errors import InputError
from mfvpr.weights.pickles import MEND, Name, excerpt, file_size, natural, of_type, read_pickle, refused

MAGIC = b"\x93NUMPY"

# By the version: bytes of the length of the header, which says that one object follows and no array.
_LENGTHS = {b"\1\0": 2, b"\2\0": 4, b"\3\0": 4}
_HEADER = re.compile(rb"\{'descr': '\|O', 'fortran_order': (False|True), 'shape': \(\)(, )?\}\s*")
_TYPES = ("f4", "f8", "i8", "i4", "i2", "i1", "u1", "b1")  # NumPy's codes
_OBJECTS = ("O8", "O4")  # of a pointer's size where they were written
_MOST_AXES = 64  # NumPy's
_LONGEST_NAME = 100  # characters
_ENTRY = 16  # bytes that an array takes in the file at least, besides its values


@dataclass
class Type:
    """Of an array's values; the order of bytes comes later."""

    code: str
    order: str | None = None  # "<", ">" or, of single bytes, "|"


@dataclass
class Array:
    """An array; what it holds comes later."""

    shape: tuple[int, ...] = ()
    type: Type | None = None
    is_fortran: bool = False
    values: Any = None  # bytes; a string of bytes; or, of objects, their list


class _Names:
    """The vocabulary."""

    def called(self, name: Name, arguments: tuple) -> Any:
        match str(name), arguments:
            case (
                "numpy.core.multiarray._reconstruct" | "numpy._core.multiarray._reconstruct",
                (Name() as kind, (0,), "b" | b"b"),
            ):
                if kind != Name("numpy", "ndarray"):
                    raise _refused(kind)
                return Array()
            case "numpy.dtype", (str(code), _, _):
                return Type(code)
            case "_codecs.encode", (str(text), "latin1"):  # bytes in protocols that have none
                return text
        raise _refused(name)

    def built(self, instance: Any, state: Any) -> None:
        match instance, state:
            case Type(order=None), (3, "<" | ">" | "|" as order, None, None, None, -1, -1, _):
                instance.order = order
            case Type(), _:  # a string, a record, a date, one with notes
                raise InputError(_unexpected(instance))
            case Array(type=None), (1, shape, Type() as kind, bool() | 0 | 1 as is_fortran, values):
                if len(of_type(tuple, shape)) > _MOST_AXES:
                    raise ValueError
                instance.shape = tuple(natural(side) for side in shape)
                instance.type, instance.is_fortran, instance.values = kind, bool(is_fortran), values
            case _:
                raise TypeError

    def stored(self, identity: Any) -> Any:
        raise TypeError


def read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Arrays by `layer.name`, read-only, in the file's own types.

    Raises:
        InputError: it holds anything else.
        LookupError, TypeError, ValueError: it is damaged.
    """
    _check_header(file)
    content = read_pickle(file, _Names())
    if file.read(1):
        raise ValueError
    match content:
        case Array(shape=(), type=Type(code=code), values=[dict() as layers]) if code in _OBJECTS and layers:
            return _arrays(layers, file_size(file))
    raise InputError("expected a dictionary of layers, got another object; use the official file")


def _check_header(file: BinaryIO) -> None:
    _, version = file.read(len(MAGIC)), file.read(2)
    length = int.from_bytes(file.read(_LENGTHS[version]), "little")
    if length > file_size(file):
        raise ValueError
    header = file.read(length)
    if not _HEADER.fullmatch(header):
        got = excerpt(header.decode("latin-1").strip())
        raise InputError(f"expected a dictionary of layers, got an array, {got}; use the official file")


def _arrays(layers: dict[Any, Any], room: int) -> dict[str, np.ndarray]:
    """The layers' arrays, which together take at most `room` bytes: in the file, many names may share a few of them."""
    arrays = {}
    for layer, parts in layers.items():
        if not isinstance(parts, dict):
            raise InputError(f"expected arrays by layer, got {type(parts).__name__} at {excerpt(str(layer))}; {MEND}")
        for name, array in parts.items():
            if len(of_type(str, layer)) + len(of_type(str, name)) > _LONGEST_NAME:
                raise ValueError
            key = f"{layer}.{name}"
            if not isinstance(array, Array):
                raise InputError(f"expected arrays by layer, got {type(array).__name__} at {excerpt(key)}; {MEND}")
            dtype = _dtype(array, key)
            size = math.prod(array.shape) * dtype.itemsize
            room -= size + _ENTRY
            if room < 0:
                raise InputError(
                    f"expected no more values than the file stores at {excerpt(key)}; use the official file"
                )
            if key in arrays or len(array.values) != size:
                raise ValueError
            arrays[key] = _values(array, dtype)
    return arrays


def _dtype(array: Array, key: str) -> np.dtype:
    if array.type is None or array.type.order is None:
        raise ValueError
    if array.type.code not in _TYPES:
        raise InputError(_unexpected(array.type, f" at {excerpt(key)}"))
    dtype = np.dtype(array.type.order + array.type.code)
    if (dtype.itemsize == 1) != (array.type.order == "|"):
        raise ValueError
    return dtype


def _values(array: Array, dtype: np.dtype) -> np.ndarray:
    content = array.values.encode("latin-1") if isinstance(array.values, str) else of_type(bytes, array.values)
    view = np.ndarray(array.shape, dtype, content, order="F" if array.is_fortran else "C")
    return view.astype(dtype.newbyteorder("="), copy=False)


def _refused(name: Name) -> InputError:
    return refused(name, "arrays of numbers")


def _unexpected(kind: Type, where: str = "") -> str:
    return f"expected arrays of float32 or float64, got {excerpt(kind.code)}{where}; use the official file"
