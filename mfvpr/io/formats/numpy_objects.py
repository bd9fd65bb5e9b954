"""Reads .npy files of Python objects, which are pickled, as plain data: arrays of numbers, alone or in lists.

NumPy itself executes what such a file asks for. Here arrays of numbers are known by their names, all else is refused.
"""

import math
import re
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from mfvpr.io.formats.pickles import Name, excerpt, file_size, natural, of_type, read_pickle, refused
from mfvpr.utils.errors import InputError

MAGIC = b"\x93NUMPY"

# By the version: bytes of the length of the header, which says that one object follows and no array.
_LENGTHS = {b"\1\0": 2, b"\2\0": 4, b"\3\0": 4}
_HEADER = re.compile(rb"\{'descr': '\|O', 'fortran_order': (False|True), 'shape': \((\d*)(?:, ?)?\)(, )?\}\s*")
_TYPES = ("f4", "f8", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "b1")  # NumPy's codes
_OBJECTS = ("O8", "O4")  # of a pointer's size where they were written
_MOST_AXES = 64  # NumPy's


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

    def num_bytes(self, where: str = "") -> int:
        """Bytes of its numbers, as its shape says; raises as `numbers` does."""
        return math.prod(self.shape) * self._dtype(where).itemsize

    def numbers(self, where: str = "") -> np.ndarray:
        """The numbers, read-only, in the file's own type.

        Args:
            where: it was found, for messages.

        Raises:
            InputError: they are no numbers.
            TypeError, ValueError: they are not as many as its shape says.
        """
        dtype = self._dtype(where)
        content = self.values.encode("latin-1") if isinstance(self.values, str) else of_type(bytes, self.values)
        if len(content) != math.prod(self.shape) * dtype.itemsize:
            raise ValueError
        view = np.ndarray(self.shape, dtype, content, order="F" if self.is_fortran else "C")
        return view.astype(dtype.newbyteorder("="), copy=False)

    def objects(self) -> list[Any]:
        """What an array of objects of one axis, or of none, holds.

        Raises:
            ValueError: it is no such array.
        """
        match self:
            case Array(type=Type(code=code), values=list() as values) if code in _OBJECTS and len(self.shape) < 2:
                if len(values) == math.prod(self.shape):
                    return values
        raise ValueError

    def _dtype(self, where: str) -> np.dtype:
        if self.type is None or self.type.order is None:
            raise ValueError
        if self.type.code not in _TYPES:
            raise InputError(_unexpected(self.type, where))
        dtype = np.dtype(self.type.order + self.type.code)
        if (dtype.itemsize == 1) != (self.type.order == "|"):
            raise ValueError
        return dtype


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


def read_objects(file: BinaryIO, expected: str) -> list[Any]:
    """What an array of objects of one axis holds, or of none: then it is one.

    Arrays among them are `Array`, lists, dictionaries, text and numbers themselves.

    Args:
        file: at its start.
        expected: what it should hold, for messages.

    Raises:
        InputError: it holds anything else.
        LookupError, TypeError, ValueError: it is damaged.
    """
    shape = _header_shape(file, expected)
    content = read_pickle(file, _Names())
    if file.read(1):
        raise ValueError
    if not isinstance(content, Array) or content.shape != shape:
        raise InputError(f"expected {expected}, got another object; use the official file")
    try:
        return content.objects()
    except ValueError:
        raise InputError(f"expected {expected}, got another object; use the official file") from None


def _header_shape(file: BinaryIO, expected: str) -> tuple[int, ...]:
    _, version = file.read(len(MAGIC)), file.read(2)
    length = int.from_bytes(file.read(_LENGTHS[version]), "little")
    if length > file_size(file):
        raise ValueError
    header = file.read(length)
    found = _HEADER.fullmatch(header)
    if not found:
        got = excerpt(header.decode("latin-1").strip())
        raise InputError(f"expected {expected}, got an array, {got}; use the official file")
    return (int(found[2]),) if found[2] else ()


def _refused(name: Name) -> InputError:
    return refused(name, "arrays of numbers")


def _unexpected(kind: Type, where: str = "") -> str:
    return f"expected arrays of integers, float32 or float64, got {excerpt(kind.code)}{where}; use the official file"
