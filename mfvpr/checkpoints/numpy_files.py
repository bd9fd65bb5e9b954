"""Read .npy files of networks as plain data: a pickled dictionary of layers, each a dictionary of arrays."""

from typing import Any, BinaryIO

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.io.formats.numpy_objects import Array, read_objects
from mfvpr.io.formats.pickles import MEND, file_size, of_type
from mfvpr.utils.errors import InputError

_MAX_NAME = 100  # characters of layer and name
_ENTRY = 16  # least bytes of an array in the file, besides its values
_EXPECTED = "a dictionary of layers"


def read_layers(file: BinaryIO) -> dict[str, np.ndarray]:
    """Read arrays by `layer.name`, read-only, in the file's own types; errors are those of `read_objects`."""
    match read_objects(file, _EXPECTED):
        case [dict() as layers] if layers:
            return _arrays(layers, file_size(file))
    raise InputError(f"expected {_EXPECTED}, got another object; use the official file")


def _arrays(layers: dict[Any, Any], room: int) -> dict[str, np.ndarray]:
    """Arrays of at most `room` bytes in total; many names may share an array of a hostile file."""
    arrays = {}
    for layer, parts in layers.items():
        if not isinstance(parts, dict):
            raise InputError(f"expected arrays by layer, got {type(parts).__name__} at {shorten(str(layer))}; {MEND}")
        for name, array in parts.items():
            if len(of_type(str, layer)) + len(of_type(str, name)) > _MAX_NAME:
                raise ValueError("a name of too many characters")
            key = f"{layer}.{name}"
            where = f" at {shorten(key)}"
            if not isinstance(array, Array):
                raise InputError(f"expected arrays by layer, got {type(array).__name__}{where}; {MEND}")
            numbers = array.numbers(where)
            room -= numbers.nbytes + _ENTRY
            if room < 0:
                raise InputError(f"expected no more values than the file stores{where}; use the official file")
            if key in arrays:
                raise ValueError("two arrays of one name")
            arrays[key] = numbers
    return arrays
