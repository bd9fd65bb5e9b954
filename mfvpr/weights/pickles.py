"""Reads what torch pickles, as data: an interpreter of the few instructions that checkpoints take, which calls nothing.

Python's own unpickler looks up and calls whatever a file names. Here a name stays a name: ordered dictionaries, tensors
and parameters are known by theirs, a training's notes beside them are left unread, and all else is refused.
"""

import pickletools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

from mfvpr.errors import InputError

_LARGEST = 1 << 22  # bytes of a pickle, which holds names and shapes; values lie elsewhere
_NOTES = {  # the command line and the losses, as D2-Net's training keeps them
    "argparse.Namespace",
    "_codecs.encode",
    "numpy.dtype",
    *(f"numpy.{core}.multiarray.scalar" for core in ("core", "_core")),
}
_MEND = "nothing was executed, use the official file"


@dataclass(frozen=True)
class Storage:
    """Where a tensor's values lie."""

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


class Content(NamedTuple):
    """Of a pickle: numbers, strings, tuples, lists, dictionaries and Tensors; and the storages of these by key."""

    value: Any
    storages: dict[str, Storage]


class Unread:
    """A note that nobody asks for."""


@dataclass(frozen=True)
class Name:
    """What a pickle asks for."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


def excerpt(text: str) -> str:
    """What a file says, short and on one line, for a message."""
    return repr(text if len(text) <= 60 else f"{text[:57]}...")[1:-1]


def read_pickle(file: BinaryIO) -> Content:
    """The next pickle of a file, which then stands behind it.

    Raises:
        InputError: it asks for anything else, or is too large.
        LookupError, TypeError, ValueError: it is damaged.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    storages: dict[str, Storage] = {}

    def popped(count: int) -> list[Any]:
        start = len(stack) - count
        if start < (marks[-1] if marks else 0):
            raise IndexError
        items = stack[start:]
        del stack[start:]
        return items

    def above_mark() -> list[Any]:
        return popped(len(stack) - marks.pop())

    start = file.tell()
    instructions: Iterator[tuple[Any, Any, Any]] = pickletools.genops(file)
    for instruction, argument, position in instructions:
        if position - start > _LARGEST:
            raise InputError(f"its pickle has more than {_LARGEST:,} bytes; {_MEND}")
        match instruction.name:
            case "PROTO":
                pass
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE":
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
            case "APPEND" | "APPENDS":
                items = popped(1) if instruction.name == "APPEND" else above_mark()
                _as(list, stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                items = popped(2) if instruction.name == "SETITEM" else above_mark()
                keys = [key if type(key) is int else _as(str, key) for key in items[::2]]
                _as(dict, stack[-1]).update(zip(keys, items[1::2], strict=True))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(Name(*argument.split(" ")))
            case "BINPERSID":
                storage = _storage(*popped(1))
                if storages.setdefault(storage.key, storage) != storage:
                    raise ValueError
                stack.append(storage)
            case "REDUCE" | "NEWOBJ":
                stack.append(_made(*popped(2)))
            case "BUILD":  # fills a note, or adds one to an ordered dictionary
                popped(1)
                if type(stack[-1]) not in (dict, Unread):
                    raise TypeError
            case "STOP":
                (value,) = popped(1)
                return Content(value, storages)
            case name:
                raise InputError(f"its pickle is more than data ({name}); {_MEND}")
    raise EOFError


def _made(name: Any, arguments: Any) -> Any:
    """What a call of this name with these arguments stands for."""
    match str(_as(Name, name)), _as(tuple, arguments):
        case "collections.OrderedDict", ():
            return {}
        case "torch._utils._rebuild_tensor_v2", (Storage() as storage, offset, shape, strides, _, _):
            return Tensor(storage, _count(offset), _counts(shape), _counts(strides))
        case "torch._utils._rebuild_parameter", (Tensor() as tensor, _, _):
            return tensor
        case note, _ if note in _NOTES:
            return Unread()
    raise _refused(name)


def _storage(identity: Any) -> Storage:
    match identity:
        case ("storage", Name("torch" | "torch.storage", kind), str(key), _, count, *rest):
            if rest not in ([], [None]):  # of older files: a view of another storage
                raise InputError(f"expected plain dense tensors, got one in a part of another's storage; {_MEND}")
            return Storage(kind, key, _count(count))
        case ("module", Name() as name, *_):
            raise _refused(name)
    raise TypeError


def _refused(name: Name) -> InputError:
    return InputError(f"it asks for {excerpt(str(name))}, where plain dense tensors are expected; {_MEND}")


def _as(kind: type, value: Any) -> Any:
    if type(value) is not kind:
        raise TypeError
    return value


def _count(value: Any) -> int:
    if _as(int, value) < 0:
        raise ValueError
    return value


def _counts(values: Any) -> tuple[int, ...]:
    return tuple(_count(value) for value in _as(tuple, values))
