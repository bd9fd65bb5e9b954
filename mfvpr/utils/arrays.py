"""Files of arrays that notice damage and exchange.

The file is NumPy's own `.npz` (`numpy.load` reads it) that ends with a digest of its content and of a label.
"""

import hashlib
import io
import os
import threading
import zipfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing

_DIGEST = hashlib.sha256().digest_size
# NumPy reads the headers of arrays by `ast.parse`, which sometimes fails when several threads call it at the same time
# (SystemError: AST constructor recursion depth mismatch; Python 3.11).
_PARSING = threading.Lock()


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], about: str = "", *, compress: bool = False, once: bool = False
) -> None:
    """Write `pack_arrays`. When this returns they are on disk; until then, the file stays. `once`: see `replacing`."""
    with replacing(path, once=once) as temporary, temporary.open("wb") as file:
        file.write(pack_arrays(arrays, about, compress=compress))
        file.flush()
        os.fsync(file.fileno())


def read_arrays(path: Path, about: str = "") -> dict[str, np.ndarray]:
    """Read the arrays of `write_arrays`; errors are those of `unpack_arrays`, and an `OSError` without a file."""
    try:
        return unpack_arrays(path.read_bytes(), about)
    except InputError as error:
        raise InputError(f"{path}: {error}; delete it") from None


def pack_arrays(arrays: Mapping[str, np.ndarray], about: str = "", *, compress: bool = False) -> bytes:
    """The content of a file of arrays of numbers, flags or text by name.

    `unpack_arrays` must get the same label `about`, so exchanged files are noticed; `compress` is for repeated values.
    """
    buffer = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind, compresslevel=1) as archive:
        archive.comment = bytes(_DIGEST)  # the end of the file
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    content = buffer.getbuffer()[:-_DIGEST]
    return bytes(content) + _digest(content, about)


def unpack_arrays(content: bytes, about: str = "") -> dict[str, np.ndarray]:
    """The arrays of `pack_arrays`; an `InputError` if a bit or the label differs."""
    view = memoryview(content)
    if view[-_DIGEST:] != _digest(view[:-_DIGEST], about):
        raise InputError("expected arrays as they were written here, got others or damaged ones")
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.namelist():
            values = archive.read(member)
            start = 10 + int.from_bytes(values[8:10], "little")  # of the values, in the format's version 1
            shape, fortran_order, dtype = _header(values[:start])
            array = np.frombuffer(values, dtype, offset=start).reshape(shape, order="F" if fortran_order else "C")
            arrays[member.removesuffix(".npy")] = array.copy()  # that may be written to
    return arrays


@lru_cache(256)
def _header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The header of an array, cached: the files of a cache have few different ones, and NumPy reads them slowly."""
    with _PARSING:
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))
    return shape, fortran_order, dtype


def _digest(content: memoryview, about: str) -> bytes:
    digest = hashlib.sha256(content)
    digest.update(about.encode("utf-8", "surrogateescape"))
    return digest.digest()
