"""Read published checkpoints as plain data; no code in a file is executed."""

import zipfile
from pathlib import Path

import numpy as np

from mfvpr.checkpoints.numpy_files import read_layers
from mfvpr.checkpoints.torch_files import read_legacy, read_zip
from mfvpr.io.formats import matlab_files, numpy_objects
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.utils.errors import InputError

_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile)
_DAMAGE += (Warning,)  # such as NumPy's for NaN among integers, if warnings are errors
# First bytes of a file -> reader; every binary pickle begins with the last ones.
_READERS = {b"PK": read_zip, numpy_objects.MAGIC: read_layers, matlab_files.MAGIC: read_matlab, b"\x80": read_legacy}


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Read arrays by key, read-only, in the file's own types.

    Keys are those of the tensors in PyTorch's files (below `model`, `state_dict` or `model_state_dict`, if nested),
    `layer.name` in NumPy's dictionaries of layers, and `variable.field.0` in MATLAB's structures and cells.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds other arrays than float32, float64 and integers.
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
    """Read the first bytes; raise an InputError unless they are those of a checkpoint."""
    again = "download it again"
    if path.exists() and not path.is_file():  # opening a pipe would block
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
