"""Read pickles as data: Python's unpickler without the instructions that import or call.

A name in a pickle becomes a `Name` and is never looked up. A subclass of `DataUnpickler` for one kind of file says
which names may be called, and builds plain data in their place.
"""

import os
import pickle
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, BinaryIO

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError

MEND = "nothing was executed, use the official file"
MAX_INSTRUCTIONS = 1 << 20  # each makes at most one object; strings are no longer than the file
_HASH_MODULUS = 2**61 - 1  # integers that differ by it have one hash; many of them take a dictionary years
_STANDARD = """
PROTO STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 FLOAT BINFLOAT
UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINSTRING SHORT_BINSTRING BINBYTES SHORT_BINBYTES BINBYTES8
EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST LIST APPEND APPENDS EMPTY_DICT
BINPUT LONG_BINPUT MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL BINPERSID
"""
_Unpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]  # in Python


@dataclass(frozen=True)
class Name:
    """Name of a class or function in a pickle."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class DataUnpickler(_Unpickler):
    """Unpickler of plain data, protocols 0 to 4, without the strings of Python 2's protocol 0.

    Other strings of Python 2, which may be text or bytes, become text in which each character is a byte.

    The base class is the unpickler in Python. The one in C allocates its memo up to the largest index that a file
    states, and hashes any key of a dictionary, which takes years for tuples of tuples.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(_bounded_file(file), encoding="latin-1")

    def load(self) -> Any:
        """Content of the next pickle of the file; the file then stands behind it.

        Raises:
            InputError: the pickle holds other than the expected data, or is too large.
            ValueError: the pickle is damaged.
        """
        self.memo = {}
        self.dispatch = _Instructions(_HANDLERS)
        try:
            return super().load()
        except (InputError, OSError):
            raise
        except Exception as error:  # a damaged file makes the unpickler raise what lists, `struct` and codecs raise
            raise ValueError("damaged pickle") from error

    def find_class(self, module: str, name: str) -> Name:
        return Name(module, name)

    def call(self, name: Name, arguments: tuple) -> Any:
        """Return what stands for the result of this call; raise an InputError if the name may not be called."""
        raise NotImplementedError

    def build(self, instance: Any, state: Any) -> None:
        """Fill the result of a call, in place."""
        raise NotImplementedError

    def load_frame(self) -> None:
        self.read(8)  # the length of the frame, which would be read at once

    def load_call(self) -> None:
        arguments, name = self.stack.pop(), self.stack.pop()
        self.append(self.call(of_type(Name, name), of_type(tuple, arguments)))

    def load_build(self) -> None:
        state = self.stack.pop()
        self.build(self.stack[-1], state)

    def load_put(self) -> None:
        index = int(self.readline())
        if not 0 <= index < _HASH_MODULUS:
            raise ValueError("an index of the memo out of range")
        self.memo[index] = self.stack[-1]

    def load_dict(self) -> None:
        keys_and_values = self.pop_mark()  # which replaces self.append
        self.append(_dictionary(keys_and_values))

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        of_type(dict, self.stack[-1]).update(_dictionary([key, value]))

    def load_setitems(self) -> None:
        keys_and_values = self.pop_mark()
        of_type(dict, self.stack[-1]).update(_dictionary(keys_and_values))


class _Instructions(dict[int, Callable]):
    """Handlers of one pickle's instructions; refuses other instructions, and too many."""

    count = 0

    def __getitem__(self, code: int) -> Callable:
        self.count += 1
        if self.count > MAX_INSTRUCTIONS:
            raise InputError(f"its pickle has more than {MAX_INSTRUCTIONS:,} instructions; {MEND}")
        if code not in self:
            name = next(opcode.name for opcode in pickletools.opcodes if ord(opcode.code) == code)
            raise InputError(f"its pickle is more than data ({name}); {MEND}")
        return super().__getitem__(code)


_HANDLERS = {
    **{code: _Unpickler.dispatch[code] for code in (getattr(pickle, name)[0] for name in _STANDARD.split())},
    pickle.FRAME[0]: DataUnpickler.load_frame,
    pickle.REDUCE[0]: DataUnpickler.load_call,
    pickle.NEWOBJ[0]: DataUnpickler.load_call,
    pickle.BUILD[0]: DataUnpickler.load_build,
    pickle.PUT[0]: DataUnpickler.load_put,
    pickle.DICT[0]: DataUnpickler.load_dict,
    pickle.SETITEM[0]: DataUnpickler.load_setitem,
    pickle.SETITEMS[0]: DataUnpickler.load_setitems,
}


def _dictionary(keys_and_values: list[Any]) -> dict[int | str, Any]:
    keys = keys_and_values[::2]
    for key in keys:
        if not (type(key) is int and abs(key) < _HASH_MODULUS):
            of_type(str, key)
    return dict(zip(keys, keys_and_values[1::2], strict=True))


def _bounded_file(file: BinaryIO) -> Any:
    """The file, without reserving memory for more bytes than it has."""
    end = file_size(file)
    return SimpleNamespace(read=lambda count: file.read(min(count, end - file.tell())), readline=file.readline)


def file_size(file: BinaryIO) -> int:
    """Bytes of an open file; its position does not change."""
    position = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(position)
    return size


def name_error(name: Name, expected: str) -> InputError:
    return InputError(f"it asks for {shorten(str(name))}, where {expected} are expected; {MEND}")


def of_type(kind: type, value: Any) -> Any:
    """The value, if its type is exactly this one; raises TypeError otherwise."""
    if type(value) is not kind:
        raise TypeError(f"expected {kind.__name__}, got {type(value).__name__}")
    return value


def natural_number(value: Any) -> int:
    """The value, if it is an int of at least 0; raises TypeError or ValueError otherwise."""
    if of_type(int, value) < 0:
        raise ValueError(f"expected at least 0, got {value}")
    return value
