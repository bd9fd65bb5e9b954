"""Reads MATLAB's files of version 5 (to 7.2) as arrays by their path through structures and cells.

SciPy's reader writes beyond its memory where a file is damaged on purpose. Here every length is checked against what
holds it, and what is no structure, cell, text or array of numbers is left out.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

from mfvpr.io.formats.pickles import file_size
from mfvpr.utils.errors import InputError

MAGIC = b"MATLAB"

_HEADER = 128  # bytes
_PACKED, _MATRIX, _NAMES, _SIZES, _FLAGS = 15, 14, 1, 5, 6  # types of elements
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # of numbers
_CODES = {2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}  # of text, by the type of its elements
_CELL, _STRUCTURE, _TEXT = 1, 2, 4  # classes of matrices; of numbers:
_NUMBERS = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX = 0x0800
_DEEPEST = 12  # matrices within each other
_MOST_AXES = 32
_MOST_UNPACKED = 20  # times the file; weights are hardly smaller when they are packed
_ALWAYS_UNPACKED = 64 << 20  # bytes of any file: names of 100,000 images take 20 MB, and a 27th of that when packed


class _Element(NamedTuple):
    kind: int
    content: memoryview


def read_matlab(file: BinaryIO, *, text: bool = False) -> dict[str, np.ndarray]:
    """Arrays by `variable.field.0.field`, where 0, 1, ... are places in a cell, or in an array of structures.

    Args:
        file: at its start.
        text: whether lines of text are given as well, as arrays of one string.

    Raises:
        InputError: it is of another version, too deep, or larger than such files are when it is unpacked.
        LookupError, ValueError: it is damaged.
    """
    header = file.read(_HEADER)
    if header.startswith(b"MATLAB 7.3"):
        raise InputError("expected a MATLAB file of version 5, got 7.3; save it with -v7, or use the official file")
    order = {b"IM": "<", b"MI": ">"}[header[126:]]
    found = {}
    for variable in _variables(file, order):
        for path, array in _arrays("", variable.content, order, 1):
            if path in found:
                raise ValueError
            if text or array.dtype.kind != "U":
                found[path] = array
    return found


def _variables(file: BinaryIO, order: str) -> Iterator[_Element]:
    """What follows the header, unpacked where it is packed."""
    size = file_size(file)
    room = max(_MOST_UNPACKED * size, _ALWAYS_UNPACKED)
    for element in _elements(memoryview(file.read()), order):
        if element.kind == _PACKED:
            content = _unpacked(element.content, room + 1)
            room -= len(content)
            if room < 0:
                raise InputError(f"expected at most {_MOST_UNPACKED} times its {size:,} bytes, got what is much larger "
                                 "when it is unpacked; use the official file")  # fmt: skip
            [element] = _elements(memoryview(content), order)
        if element.kind == _MATRIX:
            yield element


def _unpacked(content: memoryview, most: int) -> bytes:
    """What was packed, up to `most` bytes of it."""
    unpacking = zlib.decompressobj()
    try:
        found = unpacking.decompress(content, max_length=most)
    except zlib.error as error:
        raise ValueError from error
    if not unpacking.eof and len(found) < most:
        raise ValueError
    return found


def _elements(content: memoryview, order: str) -> Iterator[_Element]:
    """One behind the other, each of a tag and what it holds."""
    start = 0
    while start < len(content):
        kind, length = _whole(content[start : start + 8], order)
        first, behind = start + 8, start + 8 + length
        if kind >> 16:  # the length as well: up to four bytes in the tag itself
            kind, length = kind & 0xFFFF, kind >> 16
            if length > 4:
                raise ValueError
            first, behind = start + 4, start + 4 + length
            start += 8
        else:
            start = behind if kind in (_MATRIX, _PACKED) else behind + -length % 8
        if behind > len(content):
            raise ValueError
        yield _Element(kind, content[first:behind])


def _arrays(path: str, content: memoryview, order: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Of a matrix, which is a variable where `path` is empty."""
    if depth > _DEEPEST:
        raise InputError("expected layers of arrays, got deeper structures; use the official file")
    parts = _elements(content, order)
    flags, _ = _whole(_next(parts, _FLAGS), order)
    shape = _whole(_next(parts, _SIZES), order)
    if len(shape) > _MOST_AXES:
        raise ValueError
    name = bytes(_next(parts, _NAMES)).decode("ascii")
    path, kind, number = path or name, flags & 0xFF, math.prod(shape)
    if kind == _CELL:
        yield from _parts([f"{path}.{place}" for place in range(_bounded(number, content))], parts, order, depth)
    elif kind == _STRUCTURE:
        fields = _fields(parts, order)
        owners = [f"{path}.{place}" for place in range(_bounded(number, content))] if number > 1 else [path] * number
        yield from _parts([f"{owner}.{field}" for owner in owners for field in fields], parts, order, depth)
    elif kind in _NUMBERS and number and not flags & _COMPLEX:
        stored = next(parts)
        values = np.frombuffer(stored.content, order + _STORED[stored.kind])
        yield path, values.astype(_NUMBERS[kind]).reshape(shape, order="F")
    elif kind == _TEXT and number and shape[0] == 1:
        yield path, np.array(_text(next(parts), order))


def _text(stored: _Element, order: str) -> str:
    code = _CODES[stored.kind]
    endian = {"<": "-le", ">": "-be"}[order] if code == "utf-16" else ""
    return bytes(stored.content).decode(code + endian)


def _parts(paths: list[str], parts: Iterator[_Element], order: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    for path in paths:
        content = _next(parts, _MATRIX)
        if len(content):  # otherwise nothing was put there
            yield from _arrays(path, content, order, depth + 1)


def _fields(parts: Iterator[_Element], order: str) -> list[str]:
    """Names of a structure's fields, all of one length, filled up with zeros."""
    [length] = _whole(_next(parts, _SIZES), order)
    names = bytes(_next(parts, _NAMES))
    if not 0 < length <= 64 or len(names) % length:
        raise ValueError
    return [names[start : start + length].partition(b"\0")[0].decode("ascii") for start in range(0, len(names), length)]


def _next(parts: Iterator[_Element], kind: int) -> memoryview:
    """The next element, which is of this type."""
    element = next(parts, None)
    if element is None or element.kind != kind:
        raise ValueError
    return element.content


def _bounded(number: int, content: memoryview) -> int:
    """A number of parts, each of which takes eight bytes at least."""
    if number > len(content) // 8:
        raise ValueError
    return number


def _whole(content: memoryview, order: str) -> tuple[int, ...]:
    """Whole numbers of four bytes, not below 0."""
    if len(content) % 4:
        raise ValueError
    return struct.unpack(f"{order}{len(content) // 4}I", content)
