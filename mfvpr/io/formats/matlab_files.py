"""Read MATLAB files of version 5 (to 7.2) as arrays, named by their path through structures and cells.

SciPy's reader writes beyond its memory if a file is damaged on purpose. This reader checks every length against the
element around it, and skips everything but structures, cells, text and arrays of numbers.
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
_COMPRESSED, _MATRIX, _NAMES, _SIZES, _FLAGS = 15, 14, 1, 5, 6  # types of elements
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # numbers
_CODES = {  # encodings of text by the type of the elements
    "<": {2: "latin-1", 4: "utf-16-le", 16: "utf-8", 17: "utf-16-le"},
    ">": {2: "latin-1", 4: "utf-16-be", 16: "utf-8", 17: "utf-16-be"},
}
_CELL, _STRUCTURE, _TEXT = 1, 2, 4  # classes of matrices; classes of numbers follow
_NUMBERS = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX = 0x0800
_MAX_DEPTH = 12  # matrices within each other
_MAX_AXES = 32
_MAX_RATIO = 20  # of decompressed to compressed bytes; weights hardly get smaller
_MIN_ROOM = 64 << 20  # decompressed bytes allowed for any file: names of 100,000 images take 20 MB, compressed 0.7 MB


class _Element(NamedTuple):
    kind: int
    content: memoryview


def read_matlab(file: BinaryIO, *, text: bool = False) -> dict[str, np.ndarray]:
    """Read arrays by path: `variable.field.0.field`, with 0, 1, ... for elements of a cell or an array of structures.

    If `text`, lines of text are read as well, as arrays of one string.

    Raises:
        InputError: the file has another version, is nested too deeply, or decompresses to too many bytes.
        LookupError, ValueError: the file is damaged.
    """
    header = file.read(_HEADER)
    if header.startswith(b"MATLAB 7.3"):
        raise InputError("expected a MATLAB file of version 5, got 7.3; save it with -v7, or use the official file")
    order = {b"IM": "<", b"MI": ">"}[header[126:]]
    arrays = {}
    for variable in _variables(file, order):
        for path, array in _arrays("", variable.content, order, 1):
            if path in arrays:
                raise ValueError(f"{path} twice")
            if text or array.dtype.kind != "U":
                arrays[path] = array
    return arrays


def _variables(file: BinaryIO, order: str) -> Iterator[_Element]:
    """Matrices behind the header, decompressed."""
    size = file_size(file)
    room = max(_MAX_RATIO * size, _MIN_ROOM)
    for element in _elements(memoryview(file.read()), order):
        if element.kind == _COMPRESSED:
            content = _unpack(element.content, room + 1)
            room -= len(content)
            if room < 0:
                most = f"at most {_MAX_RATIO} times its {size:,} bytes"
                raise InputError(f"expected {most} when it is unpacked; use the official file")
            [element] = _elements(memoryview(content), order)
        if element.kind == _MATRIX:
            yield element


def _unpack(content: memoryview, max_length: int) -> bytes:
    decompressor = zlib.decompressobj()
    try:
        unpacked = decompressor.decompress(content, max_length=max_length)
    except zlib.error as error:
        raise ValueError("damaged compressed data") from error
    if not decompressor.eof and len(unpacked) < max_length:
        raise ValueError("incomplete compressed data")
    return unpacked


def _elements(content: memoryview, order: str) -> Iterator[_Element]:
    """Consecutive elements, each a tag (type and length) and its content."""
    start = 0
    while start < len(content):
        kind, length = _integers(content[start : start + 8], order)
        first, behind = start + 8, start + 8 + length
        if kind >> 16:  # short form: type and length in one number, then up to four bytes of content
            kind, length = kind & 0xFFFF, kind >> 16
            if length > 4:
                raise ValueError("too long for a short element")
            first, behind = start + 4, start + 4 + length
            start += 8
        else:
            start = behind if kind in (_MATRIX, _COMPRESSED) else behind + -length % 8
        if behind > len(content):
            raise ValueError("an element longer than its parent")
        yield _Element(kind, content[first:behind])


def _arrays(path: str, content: memoryview, order: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays by path in a matrix, which is a variable if `path` is empty."""
    if depth > _MAX_DEPTH:
        raise InputError("expected layers of arrays, got deeper structures; use the official file")
    parts = _elements(content, order)
    flags, _ = _integers(_next(parts, _FLAGS), order)
    shape = _integers(_next(parts, _SIZES), order)
    if len(shape) > _MAX_AXES:
        raise ValueError("too many axes")
    name = bytes(_next(parts, _NAMES)).decode("ascii")
    path, kind, number = path or name, flags & 0xFF, math.prod(shape)
    if kind in (_CELL, _STRUCTURE) and number > len(content) // 8:  # an element takes at least eight bytes
        raise ValueError("more elements than bytes")
    if kind == _CELL:
        yield from _parts([f"{path}.{place}" for place in range(number)], parts, order, depth)
    elif kind == _STRUCTURE:
        fields = _fields(parts, order)
        owners = [f"{path}.{place}" for place in range(number)] if number > 1 else [path] * number
        yield from _parts([f"{owner}.{field}" for owner in owners for field in fields], parts, order, depth)
    elif kind in _NUMBERS and number and not flags & _COMPLEX:
        stored = next(parts)
        values = np.frombuffer(stored.content, order + _STORED[stored.kind])
        yield path, values.astype(_NUMBERS[kind]).reshape(shape, order="F")
    elif kind == _TEXT and number and shape[0] == 1:
        stored = next(parts)
        yield path, np.array(bytes(stored.content).decode(_CODES[order][stored.kind]))


def _parts(paths: list[str], parts: Iterator[_Element], order: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    for path in paths:
        content = _next(parts, _MATRIX)
        if len(content):  # empty for elements that were never assigned
            yield from _arrays(path, content, order, depth + 1)


def _fields(parts: Iterator[_Element], order: str) -> list[str]:
    """Names of a structure's fields; zeros pad them to one length."""
    [length] = _integers(_next(parts, _SIZES), order)
    names = bytes(_next(parts, _NAMES))
    if not 0 < length <= 64 or len(names) % length:
        raise ValueError("names of fields of another length")
    return [names[start : start + length].partition(b"\0")[0].decode("ascii") for start in range(0, len(names), length)]


def _next(parts: Iterator[_Element], kind: int) -> memoryview:
    """Content of the next element, which has this type."""
    element = next(parts, None)
    if element is None or element.kind != kind:
        raise ValueError("an element of another type")
    return element.content


def _integers(content: memoryview, order: str) -> tuple[int, ...]:
    """Unsigned integers of four bytes."""
    if len(content) % 4:
        raise ValueError("incomplete integers")
    return struct.unpack(f"{order}{len(content) // 4}I", content)
