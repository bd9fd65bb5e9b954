"""Read published checkpoints as plain data; no code in a file is executed."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from mfvpr.checkpoints.torch_files import read_legacy, read_zip
from mfvpr.io.containers import reading, shorten
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.io.formats.pickles import NUMPY_MAGIC, PickledArray, read_objects
from mfvpr.utils.errors import InputError

_LAYERS = "a dictionary of layers"


def read_checkpoint(path: Path | str) -> dict[str, np.ndarray]:
    """Read arrays by key, in the file's own types.

    Keys are those of the tensors in PyTorch's files (below `model`, `state_dict` or `model_state_dict`, if nested),
    `layer.name` in NumPy's dictionaries of layers, and `variable.field.0` in MATLAB's structures and cells.

    Raises:
        InputError: the file is no checkpoint, is damaged, or holds other content.
    """
    path = Path(path)
    start = require_checkpoint(path)
    (read,) = (read for magic, read in _READERS.items() if start.startswith(magic))
    with reading(path, "a checkpoint file", "download it again"), path.open("rb") as file:
        return read(file)


def require_checkpoint(path: Path) -> bytes:
    """Read the first bytes; raise an InputError unless they are those of a checkpoint."""
    with reading(path, "a checkpoint file", "download it again"), path.open("rb") as file:
        start = file.read(64)
    if not start.startswith(tuple(_READERS)):
        kind = "an empty file" if not start else "a text file, perhaps a web page" if start.isascii() else "another"
        raise InputError(f"{path}: expected a checkpoint of torch, NumPy or MATLAB, got {kind}; download it again")
    return start


def _read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read a .npy file with a pickled dictionary of layers."""
    [layers] = read_objects(file, _LAYERS)
    arrays = {}
    for layer, parts in layers.items():
        for name, array in parts.items():
            key = f"{layer}.{name}"
            if not isinstance(array, PickledArray) or not isinstance(array.content, np.ndarray):
                raise InputError(f"expected arrays by layer, got {type(array).__name__} at {shorten(key)}")
            arrays[key] = array.content
    if not arrays:
        raise InputError(f"expected {_LAYERS}, got none; use the official file")
    return arrays


# First bytes of a file -> reader; every binary pickle begins with the last ones.
_READERS = {b"PK": read_zip, NUMPY_MAGIC: _read_layers, b"MATLAB": read_matlab, b"\x80": read_legacy}
