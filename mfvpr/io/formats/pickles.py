"""Reads pickles as data: an interpreter of the instructions that hold data, which calls nothing.

Python's own unpickler looks up and calls whatever a file names. Here a name stays a name: a reader of one kind of file
says what the few that it knows stand for, and all else is refused.
"""

import os
import pickletools
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, BinaryIO, Protocol

from mfvpr.utils.errors import InputError

_MOST = 1 << 20  # instructions, of which each makes one object; strings hold as much as the file at most
MEND = "nothing was executed, use the official file"


@dataclass(frozen=True)
class Name:
    """What a pickle asks for."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class Vocabulary(Protocol):
    """What the names of one kind of file stand for.

    Each method raises InputError for what has no place there, and TypeError or ValueError for what is damaged.
    """

    def called(self, name: Name, arguments: tuple) -> Any:
        """What a call of this name gives."""
        ...

    def built(self, instance: Any, state: Any) -> None:
        """Fill what a call gave, in place."""
        ...

    def stored(self, identity: Any) -> Any:
        """What lies outside of the pickle under this identity."""
        ...


def excerpt(text: str) -> str:
    """What a file says, short and on one line, for a message."""
    return repr(text if len(text) <= 60 else f"{text[:57]}...")[1:-1]


def refused(name: Name, expected: str) -> InputError:
    """That a pickle asks for this name where something else is expected."""
    return InputError(f"it asks for {excerpt(str(name))}, where {expected} are expected; {MEND}")


def file_size(file: BinaryIO) -> int:
    """Bytes of an open file, which stays where it is."""
    place = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(place)
    return size


def read_pickle(file: BinaryIO, vocabulary: Vocabulary) -> Any:
    """What the next pickle of a file holds; the file then stands behind it.

    Protocols 0 to 4, without the strings of Python 2's protocol 0. Those of its other protocols, which may be text or
    bytes, become text in which each character is a byte.

    Raises:
        InputError: it asks for anything else, or is too large.
        LookupError, TypeError, ValueError: it is damaged.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def popped(count: int) -> list[Any]:
        start = len(stack) - count
        if start < (marks[-1] if marks else 0):
            raise IndexError
        items = stack[start:]
        del stack[start:]
        return items

    def above_mark() -> list[Any]:
        return popped(len(stack) - marks.pop())

    instructions: Iterator[tuple[Any, Any, Any]] = pickletools.genops(_bounded(file))
    for count, (instruction, argument, _) in enumerate(instructions):
        if count >= _MOST:
            raise InputError(f"its pickle has more than {_MOST:,} instructions; {MEND}")
        match instruction.name:
            case "PROTO" | "FRAME":
                pass
            case "INT" | "BININT" | "BININT1" | "BININT2" | "LONG" | "LONG1" | "FLOAT" | "BINFLOAT":
                stack.append(argument)
            case "UNICODE" | "BINUNICODE" | "SHORT_BINUNICODE" | "BINUNICODE8" | "BINSTRING" | "SHORT_BINSTRING":
                stack.append(argument)
            case "BINBYTES" | "SHORT_BINBYTES" | "BINBYTES8":
                stack.append(argument)
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[instruction.name])
            case "EMPTY_DICT" | "EMPTY_LIST" | "EMPTY_TUPLE":
                stack.append({"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}[instruction.name]())
            case "MARK":
                marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(above_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(popped(int(instruction.name[-1]))))
            case "LIST":
                stack.append(above_mark())
            case "DICT":
                stack.append(_entries(above_mark()))
            case "APPEND" | "APPENDS":
                items = popped(1) if instruction.name == "APPEND" else above_mark()
                of_type(list, stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                items = popped(2) if instruction.name == "SETITEM" else above_mark()
                of_type(dict, stack[-1]).update(_entries(items))
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(Name(*argument.split(" ")))
            case "STACK_GLOBAL":
                stack.append(Name(*(of_type(str, part) for part in popped(2))))
            case "BINPERSID":
                stack.append(vocabulary.stored(*popped(1)))
            case "REDUCE" | "NEWOBJ":
                name, arguments = popped(2)
                stack.append(vocabulary.called(of_type(Name, name), of_type(tuple, arguments)))
            case "BUILD":
                (state,) = popped(1)
                vocabulary.built(stack[-1], state)
            case "STOP":
                (value,) = popped(1)
                return value
            case name:
                raise InputError(f"its pickle is more than data ({name}); {MEND}")
    raise EOFError


def of_type(kind: type, value: Any) -> Any:
    """The value, where it is of this type and no other.

    Raises:
        TypeError: it is not.
    """
    if type(value) is not kind:
        raise TypeError
    return value


def natural(value: Any) -> int:
    """The value, where it is a number of things.

    Raises:
        TypeError, ValueError: it is not.
    """
    if of_type(int, value) < 0:
        raise ValueError
    return value


def _entries(items: list[Any]) -> dict[int | str, Any]:
    """A dictionary of alternating keys and values."""
    keys = [key if type(key) is int else of_type(str, key) for key in items[::2]]
    return dict(zip(keys, items[1::2], strict=True))


def _bounded(file: BinaryIO) -> Any:
    """The file as `pickletools` reads it; a length that the pickle states takes no more memory than the file has."""
    end = file_size(file)
    return SimpleNamespace(
        read=lambda count: file.read(min(count, end - file.tell())), readline=file.readline, tell=file.tell
    )
