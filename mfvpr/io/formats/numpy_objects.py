"""Read .npy files of Python objects, which are pickled, as plain data: arrays of numbers, alone or in lists."""

import math
import re
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.io.formats.pickles import DataUnpickler, Name, file_size, name_error, natural_number, of_type
from mfvpr.utils.errors import InputError

MAGIC = b"\x93NUMPY"

_LENGTH_BYTES = {b"\1\0": 2, b"\2\0": 4, b"\3\0": 4}  # version -> bytes of the header's length
_HEADER = re.compile(rb"\{'descr': '\|O', 'fortran_order': (False|True), 'shape': \((\d*)(?:, ?)?\)(, )?\}\s*")
_NUMBERS = ("f4", "f8", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "b1")  # NumPy's codes of types
_OBJECTS = ("O8", "O4")  # by the size of a pointer where the file was written
_MAX_AXES = 64  # of NumPy


@dataclass
class Type:
    """Type of an array's values; the byte order is filled in later."""

    code: str
    order: str | None = None  # "<", ">", or "|" for single bytes


@dataclass
class Array:
    """An array; shape, type and values are filled in later."""

    shape: tuple[int, ...] = ()
    type: Type | None = None
    is_fortran: bool = False
    values: Any = None  # bytes, a string of bytes, or a list of objects

    def numbers(self, where: str = "") -> np.ndarray:
        """The numbers, read-only, in the file's own type; `where` ends the message of an error.

        Raises:
            InputError: the array does not hold numbers.
            TypeError, ValueError: the number of values does not fit the shape.
        """
        if self.type is None or self.type.order is None:
            raise ValueError("an array without a type")
        if self.type.code not in _NUMBERS:
            raise _type_error(self.type, where)
        dtype = np.dtype(self.type.order + self.type.code)
        if (dtype.itemsize == 1) != (self.type.order == "|"):
            raise ValueError("the byte order does not fit the type")
        content = self.values.encode("latin-1") if isinstance(self.values, str) else of_type(bytes, self.values)
        if len(content) != math.prod(self.shape) * dtype.itemsize:
            raise ValueError("the number of values does not fit the shape")
        view = np.ndarray(self.shape, dtype, content, order="F" if self.is_fortran else "C")
        return view.astype(dtype.newbyteorder("="), copy=False)


class ArrayUnpickler(DataUnpickler):
    """Unpickler of `Array` among plain data."""

    def call(self, name: Name, arguments: tuple) -> Any:
        match str(name), arguments:
            case (
                "numpy.core.multiarray._reconstruct" | "numpy._core.multiarray._reconstruct",
                (Name() as array_class, (0,), "b" | b"b"),
            ):
                if array_class != Name("numpy", "ndarray"):
                    raise name_error(array_class, "arrays of numbers")
                return Array()
            case "numpy.dtype", (str(code), _, _):
                return Type(code)
            case "_codecs.encode", (str(text), "latin1"):  # bytes in protocols that have none
                return text
            case "__builtin__.bytes" | "builtins.bytes", ():  # of an array without values
                return b""
        raise name_error(name, "arrays of numbers")

    def build(self, instance: Any, state: Any) -> None:
        match instance, state:
            case Type(order=None), (3, "<" | ">" | "|" as order, None, None, None, -1, -1, _):
                instance.order = order
            case Type(), _:  # text, records, dates, types with metadata
                raise _type_error(instance)
            case Array(type=None), (1, shape, Type() as array_type, bool() | 0 | 1 as is_fortran, values):
                if len(of_type(tuple, shape)) > _MAX_AXES:
                    raise ValueError("too many axes")
                instance.shape = tuple(natural_number(side) for side in shape)
                instance.type, instance.is_fortran, instance.values = array_type, bool(is_fortran), values
            case _:
                raise TypeError("expected an empty array or type, and its state")


def read_objects(file: BinaryIO, expected: str) -> list[Any]:
    """Objects of an array with one axis, or the only object of an array without axes; `expected` is for messages.

    Arrays among the objects are `Array`; lists, dictionaries, text and numbers are themselves.

    Raises:
        InputError: the file holds other content.
        LookupError, TypeError, ValueError: the file is damaged.
    """
    shape = _header_shape(file, expected)
    content = ArrayUnpickler(file).load()
    if file.read(1):
        raise ValueError("bytes after the pickle")
    match content:
        case Array(type=Type(code=code), values=list() as objects) if code in _OBJECTS and content.shape == shape:
            if len(objects) == math.prod(shape):
                return objects
    raise InputError(f"expected {expected}, got another object; use the official file")


def _header_shape(file: BinaryIO, expected: str) -> tuple[int, ...]:
    _, version = file.read(len(MAGIC)), file.read(2)
    length = int.from_bytes(file.read(_LENGTH_BYTES[version]), "little")
    if length > file_size(file):
        raise ValueError("a header longer than the file")
    header = file.read(length)
    fields = _HEADER.fullmatch(header)
    if not fields:
        got = shorten(header.decode("latin-1").strip())
        raise InputError(f"expected {expected}, got an array, {got}; use the official file")
    return (int(fields[2]),) if fields[2] else ()


def _type_error(array_type: Type, where: str = "") -> InputError:
    code = shorten(array_type.code)
    return InputError(f"expected arrays of integers, float32 or float64, got {code}{where}; use the official file")
