"""Read files that may hold more than data, as data: pickles of NumPy and PyTorch, and MATLAB's files.

Nothing in a file is executed: a pickle may ask only for the names of an unpickler, each of which has a stand-in.
"""

import io
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO, ClassVar

import numpy as np
import scipy  # its subpackages are imported at their first use

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError


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


class ArrayUnpickler(DataUnpickler):
    """Unpickler of NumPy's arrays among plain data; paths become text."""

    names: ClassVar = {
        f"{module}.{name}": stand_in
        for modules, name, stand_in in (
            # An empty array, which the pickle fills.
            (("numpy.core.multiarray", "numpy._core.multiarray"), "_reconstruct", lambda *_: np.ndarray(0, np.int8)),
            (("numpy",), "ndarray", np.ndarray),
            (("numpy",), "dtype", lambda code, *_: np.dtype(code, copy=True)),  # NumPy's own types stay as they are
            (("_codecs",), "encode", lambda text, *_: text.encode("latin-1")),  # bytes in protocols that have none
            (("__builtin__", "builtins"), "bytes", bytes),  # of an array without values
            (("pathlib", "pathlib._local"), "PosixPath", lambda *parts: PurePosixPath(*parts).as_posix()),
            (("pathlib", "pathlib._local"), "WindowsPath", lambda *parts: PureWindowsPath(*parts).as_posix()),
        )
        for module in modules
    }


@contextmanager
def open_torch_archive(file: BinaryIO) -> Iterator[tuple[zipfile.ZipFile, str, BinaryIO]]:
    """The zip file of `torch.save`, the folder of its entries (with a slash), and its pickle.

    Entries have the values of storages. An InputError if entries are compressed, or damaged by their checksums.
    """
    with zipfile.ZipFile(file) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise InputError("expected uncompressed entries of the zip, got compressed ones; use the official file")
        if broken := archive.testzip():
            raise InputError(f"expected a whole file, got another checksum of {shorten(broken)}; get it again")
        pickles = [name for name in archive.namelist() if name.split("/")[1:] == ["data.pkl"]]
        if len(pickles) != 1:
            raise InputError("expected a file of torch.save, got another zip file; save it again")
        yield archive, pickles[0].removesuffix("data.pkl"), io.BytesIO(archive.read(pickles[0]))


def read_matlab(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read arrays by path: `variable.field.0.field`, with 0, 1, ... for elements of a cell or an array of structures.

    Reads versions 4 to 7.2. SciPy's errors are raised if the file is damaged.
    """
    arrays = {}

    def collect(path: str, value: Any) -> None:
        if value.dtype.names:  # structures
            for place, structure in enumerate(value.ravel(order="F")):
                owner = path if value.size == 1 else f"{path}.{place}"
                for field in value.dtype.names:
                    collect(f"{owner}.{field}", structure[field])
        elif value.dtype == object:  # a cell
            for place, part in enumerate(value.ravel(order="F")):
                collect(f"{path}.{place}", part)
        elif value.dtype.kind in "fiu" and value.size:
            arrays[path] = value

    for name, value in scipy.io.loadmat(file, mat_dtype=True).items():
        if not name.startswith("__"):
            collect(name, value)
    return arrays
