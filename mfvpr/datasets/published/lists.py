"""Images that a list names, and lists of NumPy's files, in which nothing is executed."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.io.formats.numpy_objects import Array, read_objects
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file

_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError)
_OBJECTS = b"'|O'"


def listed_images(root: Path, names: Iterable[str], origin: Path) -> ImageFolder:
    """The images below `root` that a list names.

    Raises:
        InputError: the list is empty, leads out of the folder, or names what is not there.
    """
    names = tuple(names)
    if not names:
        raise InputError(f"{origin}: expected names of images, got none")
    for name in names:
        if name.startswith("/") or ".." in name.split("/"):
            raise InputError(f"{origin}: expected names below {root}, got {name}")
    if len({*names}) < len(names):
        twice = next(name for row, name in enumerate(names) if name in names[:row])
        raise InputError(f"{origin}: expected every image once, got {twice} again; get the file again")
    missing = [name for name in names if not (root / name).is_file()]
    if missing:
        raise InputError(f"{root}: {len(missing):,} of the {len(names):,} images of {origin.name} are missing, the "
                         f"first is {missing[0]}; get the whole data set")  # fmt: skip
    return ImageFolder(root, names)


def expected_file(root: Path, *names: str) -> Path | None:
    """The first of these that is there."""
    return next((root / name for name in names if (root / name).is_file()), None)


def read_lines(path: Path) -> list[str]:
    """Lines that are not empty, without the spaces around them.

    Raises:
        InputError: the file cannot be read.
    """
    require_file(path, "a list")
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    return [stripped for line in text.splitlines() if (stripped := line.strip())]


def read_names(path: Path) -> list[str]:
    """Names of an `.npy` file of text."""
    names = _array(path)
    if names.ndim != 1 or names.dtype.kind != "U":
        raise InputError(f"{path}: expected a list of names, got {names.dtype} {list(names.shape)}")
    return [str(name) for name in names]


def read_rows(path: Path, num_database: int) -> list[tuple[int, ...]]:
    """Rows of the database by query, of an `.npy` file of lists, or of an array `[Q]` or `[Q, P]`.

    Raises:
        InputError: the file is another, is damaged, or a row is none of the database.
    """
    rows = _rows(path)
    if rows and num_database > 2 and all(len(found) == num_database and {*found} <= {0, 1} for found in rows):
        raise InputError(f"{path}: expected rows of the database, got flags for each of them; get the file again")
    for query, found in enumerate(rows):
        if found and not 0 <= min(found) <= max(found) < num_database:
            raise InputError(f"{path}: query {query}: expected rows from 0 to {num_database - 1}, got "
                             f"{min(found)} to {max(found)}")  # fmt: skip
    return rows


def _rows(path: Path) -> list[tuple[int, ...]]:
    require_file(path, "a list")
    try:
        with path.open("rb") as file:
            if _OBJECTS not in file.read(128):
                return [tuple(np.atleast_1d(row).tolist()) for row in _whole(_array(path), path)]
            file.seek(0)
            return [_row(one, path) for one in read_objects(file, "lists of rows")]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except _DAMAGE:
        raise InputError(f"{path}: this file is damaged; get it again") from None


def _row(one: Any, path: Path) -> tuple[int, ...]:
    numbers = one.numbers() if isinstance(one, Array) else np.array(one)
    return tuple(_whole(numbers.reshape(-1), path).tolist()) if numbers.size else ()


def _whole(numbers: np.ndarray, path: Path) -> np.ndarray:
    if numbers.dtype.kind not in "iu" or numbers.ndim > 2:
        raise InputError(f"{path}: expected lists of rows, got {numbers.dtype} {list(numbers.shape)}")
    return numbers


def _array(path: Path) -> np.ndarray:
    require_file(path, "a list")
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (ValueError, EOFError):
        raise InputError(f"{path}: expected an array of NumPy; get it again") from None
