"""Arrays in one file that is whole, unchanged and the one that was meant; or an error.

The file is NumPy's own `.npz` (`numpy.load` reads it) that ends with a digest of what it holds and of what it is about.
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
# NumPy reads the headers of arrays by `ast.parse`, which fails now and then where several threads call it at the same
# time (SystemError: AST constructor recursion depth mismatch; Python 3.11).
_PARSING = threading.Lock()


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], about: str = "", *, compress: bool = False) -> None:
    """Write arrays by name. When this returns they are on disk; until then, whatever was there before.

    Args:
        path: `.npz`.
        arrays: of numbers, flags or text.
        about: what the arrays are of; who reads them must say the same, so exchanged files are noticed.
        compress: worth its time where values come again; numbers that look random shrink by a tenth.

    Raises:
        OSError: the disk is full, or cannot be written.
        ValueError: an array of Python objects.
    """
    buffer = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind, compresslevel=1) as archive:
        archive.comment = bytes(_DIGEST)  # the end of the file
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    content = buffer.getbuffer()[:-_DIGEST]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.write(_digest(content, about))
        file.flush()
        os.fsync(file.fileno())


def read_arrays(path: Path, about: str = "") -> dict[str, np.ndarray]:
    """What `write_arrays` wrote.

    Raises:
        InputError: any bit differs, or the arrays are about something else.
        OSError: there is no such file, or it cannot be read.
    """
    content = path.read_bytes()
    whole = memoryview(content)
    if whole[-_DIGEST:] != _digest(whole[:-_DIGEST], about):
        raise InputError(f"{path}: expected arrays as they were written here, got others or damaged ones; delete it")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {
            member.filename.removesuffix(".npy"): _array(_values(archive, member, whole)) for member in archive.filelist
        }


def _values(archive: zipfile.ZipFile, member: zipfile.ZipInfo, whole: memoryview) -> bytes | memoryview:
    """What a member holds; where it is as it stands in the file, without another checksum and two copies."""
    if member.compress_type != zipfile.ZIP_STORED:
        return archive.read(member)
    name, extra = (int.from_bytes(whole[member.header_offset + at :][:2], "little") for at in (26, 28))
    start = member.header_offset + 30 + name + extra
    return whole[start : start + member.file_size]


def _array(member: bytes | memoryview) -> np.ndarray:
    start = 10 + int.from_bytes(member[8:10], "little")  # of the values, in the format's version 1
    shape, fortran_order, dtype = _header(bytes(member[:start]))
    return np.frombuffer(member, dtype, offset=start).reshape(shape, order="F" if fortran_order else "C").copy()


@lru_cache(256)
def _header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """What stands before an array's values: rows of one store have few different ones, and NumPy is slow to read them.

    Raises:
        ValueError: another version of the format, or an array of Python objects.
    """
    if header[6:8] != b"\x01\x00":
        raise ValueError(f"expected an array in version 1.0 of NumPy's format, got {header[6]}.{header[7]}")
    with _PARSING:
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    return shape, fortran_order, dtype


def _digest(content: memoryview, about: str) -> bytes:
    digest = hashlib.sha256(content)
    digest.update(about.encode("utf-8", "surrogateescape"))
    return digest.digest()
