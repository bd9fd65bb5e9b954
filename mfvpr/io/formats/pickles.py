"""Read pickles as data: Python's unpickler with a list of the names that a file may ask for.

Each of these names has a stand-in. No other name is looked up, and nothing in a file is executed.
"""

import io
import pickle
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import PurePath, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO, ClassVar, NamedTuple

import numpy as np

from mfvpr.io.containers import read_npy_header, shorten
from mfvpr.utils.errors import InputError

NUMPY_MAGIC = b"\x93NUMPY"
_NUMBERS = "fiub"  # kinds of NumPy's types


class Function:
    """Stand-in of a function or class that a pickle may call; a pickle cannot change it."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise InputError("a function has no state")


class DataUnpickler(pickle.Unpickler):
    """Unpickler of plain data and of `names`: `module.name` -> what stands for it.

    Strings of Python 2, which may be text or bytes, become text in which each character is a byte.
    """

    names: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file, encoding="latin-1")

    def find_class(self, module: str, name: str) -> Any:
        full_name = f"{module}.{name}"
        if full_name not in self.names:
            raise InputError(f"its pickle asks for {shorten(full_name)}; nothing was executed, use the official file")
        return self.names[full_name]


class _Type:
    """Type of an array's values: its code, then its byte order."""

    __slots__ = ("code", "dtype")

    def __init__(self, code: str) -> None:
        self.code = code
        self.dtype: np.dtype | None = None

    def __setstate__(self, state: tuple) -> None:
        if state[1] not in "<>|" or state[2:5] != (None, None, None):
            raise InputError(f"expected arrays of numbers, got {shorten(self.code)}; use the official file")
        self.dtype = np.dtype(f"{state[1]}{self.code}")


class PickledArray:
    """An array in a pickle: `content` is an array of numbers, or a list of objects."""

    __slots__ = ("content", "shape")

    def __init__(self) -> None:
        self.content: Any = None
        self.shape: tuple[int, ...] = ()

    def __setstate__(self, state: tuple) -> None:
        _, self.shape, array_type, is_fortran, values = state
        if array_type.dtype.kind == "O":
            self.content = list(values)
            return
        if array_type.dtype.kind not in _NUMBERS:
            raise InputError(f"expected arrays of numbers, got {shorten(array_type.code)}; use the official file")
        content = values.encode("latin-1") if isinstance(values, str) else values
        array = np.frombuffer(content, array_type.dtype).reshape(self.shape, order="F" if is_fortran else "C")
        self.content = array.astype(array.dtype.newbyteorder("="), copy=False)


def _path_text(kind: type[PurePath], *parts: str) -> str:
    return kind(*parts).as_posix()


class ArrayUnpickler(DataUnpickler):
    """Unpickler of `PickledArray` among plain data; paths become text."""

    names: ClassVar = {
        "numpy.core.multiarray._reconstruct": Function(lambda *_: PickledArray()),
        "numpy._core.multiarray._reconstruct": Function(lambda *_: PickledArray()),
        "numpy.ndarray": Function(lambda *_: PickledArray()),
        "numpy.dtype": Function(lambda code, *_: _Type(code)),
        "_codecs.encode": Function(lambda text, *_: text),  # bytes in protocols that have none
        "__builtin__.bytes": Function(bytes),  # of an array without values
        "builtins.bytes": Function(bytes),
        **{
            f"{module}.{prefix}{kind.__name__.removeprefix('Pure')}": Function(partial(_path_text, kind))
            for module in ("pathlib", "pathlib._local")
            for prefix in ("", "Pure")
            for kind in (PurePosixPath, PureWindowsPath)
        },
    }


def read_objects(file: BinaryIO, expected: str) -> list[Any]:
    """Objects of a `.npy` file; arrays among them are `PickledArray`, `expected` is for messages.

    Raises:
        InputError: the file holds other content; any error if it is damaged.
    """
    shape, _, dtype = read_npy_header(file)
    content = ArrayUnpickler(file).load() if dtype.hasobject else None
    if not isinstance(content, PickledArray) or not isinstance(content.content, list) or content.shape != shape:
        raise InputError(f"expected {expected}, got another object of {dtype} {[*shape]}; use the official file")
    return content.content


class TorchArchive(NamedTuple):
    """An open zip file of `torch.save`: a pickle, and an entry for the values of each storage."""

    archive: zipfile.ZipFile
    folder: str  # of its entries, with a slash
    pickle: BinaryIO


@contextmanager
def open_torch_archive(file: BinaryIO) -> Iterator[TorchArchive]:
    """Check an uncompressed file and its checksums; an InputError if entries are compressed or damaged."""
    with zipfile.ZipFile(file) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise InputError("expected uncompressed entries of the zip file; use the official file")
        if broken := archive.testzip():
            raise InputError(f"the file is damaged, by the checksum of {shorten(broken)}; get it again")
        pickles = [name for name in archive.namelist() if name.split("/")[1:] == ["data.pkl"]]
        if len(pickles) != 1:
            raise InputError("expected a file of torch.save, got another zip file")
        yield TorchArchive(archive, pickles[0].removesuffix("data.pkl"), io.BytesIO(archive.read(pickles[0])))
