"""Read MATLAB files as arrays, named by their path through structures and cells."""

from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
import scipy  # its subpackages are imported at their first use

_NUMBERS = "fiu"


def read_matlab(file: BinaryIO, *, text: bool = False) -> dict[str, np.ndarray]:
    """Read arrays by path: `variable.field.0.field`, with 0, 1, ... for elements of a cell or an array of structures.

    Reads versions 4 to 7.2. If `text`, lines of text are read as well, as arrays of one string. SciPy's errors are
    raised if the file is damaged.
    """
    variables = {
        name: value for name, value in scipy.io.loadmat(file, mat_dtype=True).items() if not name.startswith("__")
    }
    arrays = dict(pair for name, value in variables.items() for pair in _arrays(name, value))
    return {path: array for path, array in arrays.items() if text or array.dtype.kind in _NUMBERS}


def _arrays(path: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of numbers and of one string in a value, by path."""
    if value.dtype.names:  # structures
        for place, structure in enumerate(value.ravel(order="F")):
            owner = path if value.size == 1 else f"{path}.{place}"
            for field in value.dtype.names:
                yield from _arrays(f"{owner}.{field}", structure[field])
    elif value.dtype == object:  # a cell
        for place, part in enumerate(value.ravel(order="F")):
            yield from _arrays(f"{path}.{place}", part)
    elif value.dtype.kind == "U" and value.size == 1:
        yield path, np.array(value.item())
    elif value.dtype.kind in _NUMBERS and value.size:
        yield path, value
