"""Reads published checkpoints as plain data: nothing in the file is executed."""

import zipfile
from pathlib import Path

import numpy as np

from mfvpr.checkpoints.numpy_files import read_layers
from mfvpr.checkpoints.torch_files import read_legacy, read_zip
from mfvpr.io.formats import matlab_files, numpy_objects
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.utils.errors import InputError

_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile)
_DAMAGE += (Warning,)  # raised where warnings are errors
# By the first bytes; the last is that of every binary pickle.
_READERS = {b"PK": read_zip, numpy_objects.MAGIC: read_layers, matlab_files.MAGIC: read_matlab, b"\x80": read_legacy}


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Arrays by key, read-only, in the file's own types.

    Of torch's files the tensors, those below `model`, `state_dict` or `model_state_dict` if nested; of NumPy's
    dictionaries of layers `layer.name`; of MATLAB's structures and cells `variable.field.0`.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds anything but float32, float64 and integer arrays.
    """
    path = Path(path)
    start = require_checkpoint(path)
    (read,) = (read for magic, read in _READERS.items() if start.startswith(magic))
    try:
        with path.open("rb") as file:
            return read(file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        raise InputError(f"{path}: this checkpoint is damaged; download it again") from error


def require_checkpoint(path: Path) -> bytes:
    """The first bytes, which are those of a checkpoint.

    Raises:
        InputError: they are not.
    """
    again = "download it again"
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise InputError(f"{path}: expected a checkpoint file, got {'a folder' if path.is_dir() else 'no plain file'}")
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: expected a checkpoint file, got: {error.strerror}") from error
    if not start:
        raise InputError(f"{path}: expected a checkpoint, got an empty file; {again}")
    if not start.startswith(tuple(_READERS)):
        kind = "a text file, perhaps a web page" if start.isascii() and b"\0" not in start else "another kind of file"
        raise InputError(f"{path}: expected a checkpoint of torch, NumPy or MATLAB, got {kind}; {again}")
    if start.startswith(b"PK") and not zipfile.is_zipfile(path):
        raise InputError(f"{path}: this checkpoint is truncated; {again}")
    return start
