"""Read published checkpoints as plain data; no code in a file is executed."""

import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mfvpr.checkpoints.torch_files import read_legacy, read_zip
from mfvpr.io.containers import shorten
from mfvpr.io.formats import matlab_files, numpy_objects
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.io.formats.pickles import MEND, file_size, of_type
from mfvpr.utils.errors import InputError

_MAX_NAME = 100  # characters of layer and name
_ENTRY = 16  # least bytes of an array in a NumPy file, besides its values
_LAYERS = "a dictionary of layers"
_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile)
_DAMAGE += (Warning,)  # such as NumPy's for NaN among integers, if warnings are errors


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


def _read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a .npy file with a pickled dictionary of layers; many names may share an array of a hostile file."""
    objects = numpy_objects.read_objects(file, _LAYERS)
    layers = objects[0] if len(objects) == 1 else None
    if not isinstance(layers, dict) or not layers:
        raise InputError(f"expected {_LAYERS}, got another object; use the official file")
    arrays, room = {}, file_size(file)
    for layer, parts in layers.items():
        if not isinstance(parts, dict):
            raise InputError(f"expected arrays by layer, got {type(parts).__name__} at {shorten(str(layer))}; {MEND}")
        for name, array in parts.items():
            if len(of_type(str, layer)) + len(of_type(str, name)) > _MAX_NAME:
                raise ValueError("a name of too many characters")
            key = f"{layer}.{name}"
            where = f" at {shorten(key)}"
            if not isinstance(array, numpy_objects.Array):
                raise InputError(f"expected arrays by layer, got {type(array).__name__}{where}; {MEND}")
            numbers = array.numbers(where)
            room -= numbers.nbytes + _ENTRY
            if room < 0:
                raise InputError(f"expected no more values than the file stores{where}; use the official file")
            if key in arrays:
                raise ValueError("two arrays of one name")
            arrays[key] = numbers
    return arrays


# First bytes of a file -> reader; every binary pickle begins with the last ones.
_READERS = {b"PK": read_zip, numpy_objects.MAGIC: _read_layers, matlab_files.MAGIC: read_matlab, b"\x80": read_legacy}
