"""Images from lists of names, and NumPy's files of lists, whose code is never executed."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, ImageFolder, QuerySequence
from mfvpr.datasets.ground_truth import FrameTruth
from mfvpr.io.containers import reading
from mfvpr.io.formats.pickles import PickledArray, read_objects
from mfvpr.utils.errors import InputError

_OBJECTS = b"'|O'"


def listed_images(root: Path, names: Iterable[str], origin: Path) -> ImageFolder:
    """The images below `root` with the names of a list."""
    names = tuple(names)
    if not names:
        raise InputError(f"{origin}: expected names of images, got none")
    for name in names:
        if name.startswith("/") or ".." in name.split("/"):
            raise InputError(f"{origin}: expected names below {root}, got {name}")
    if len({*names}) < len(names):
        duplicate = next(name for row, name in enumerate(names) if name in names[:row])
        raise InputError(f"{origin}: expected every image once, got {duplicate} again; get the file again")
    missing = [name for name in names if not (root / name).is_file()]
    if missing:
        raise InputError(f"{root}: {len(missing):,} of the {len(names):,} images of {origin.name} are missing, the "
                         f"first is {missing[0]}; get the whole data set")  # fmt: skip
    return ImageFolder(root, names)


def dataset_of_lists(
    root: Path, name: str, database_list: Path, query_list: Path, truth_list: Path, selection_list: Path | None = None
) -> Dataset:
    """Data set from NumPy's lists of GSV-Cities and OpenVPRLab: image names, and correct database rows by query.

    `selection_list` has the rows of `query_list` that are queries; None = all.
    """
    database = listed_images(root, read_names(database_list), database_list)
    names, rows = read_names(query_list), read_rows(truth_list, len(database))
    expected = f"{len(names)} queries"
    if selection_list is not None:
        names = [names[row] for selection in read_rows(selection_list, len(names)) for row in selection]
        expected = f"the {len(names)} queries of {selection_list.name}"
    if len(rows) != len(names):
        raise InputError(f"{truth_list}: expected rows of {expected}, got {len(rows)}")
    truth = FrameTruth(tuple(rows), len(database), widened=False)
    return Dataset(name, database, (QuerySequence(name, listed_images(root, names, query_list), truth),))


def expected_file(root: Path, *names: str) -> Path | None:
    """The first of several files that exists."""
    return next((root / name for name in names if (root / name).is_file()), None)


def read_lines(path: Path) -> list[str]:
    """Read lines that are not empty, without the spaces around them."""
    with reading(path, "a list", "get it again"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    return [stripped for line in text.splitlines() if (stripped := line.strip())]


def read_names(path: Path) -> list[str]:
    """Read names from an `.npy` file of text."""
    names = _read_array(path)
    if names.ndim != 1 or names.dtype.kind != "U":
        raise InputError(f"{path}: expected a list of names, got {names.dtype} {list(names.shape)}")
    return [str(name) for name in names]


def read_rows(path: Path, num_database: int) -> list[tuple[int, ...]]:
    """Read database rows by query from an `.npy` file of lists, or of an array `[Q]` or `[Q, P]`."""
    with reading(path, "a list", "get it again"), path.open("rb") as file:
        if _OBJECTS in file.read(128):
            file.seek(0)
            lists = read_objects(file, "lists of rows")
            lists = (rows.content if isinstance(rows, PickledArray) else rows for rows in lists)
            arrays = (np.asarray(rows).reshape(-1) for rows in lists)
            per_query = (_require_integers(rows, path) if rows.size else rows for rows in arrays)
        else:
            per_query = map(np.atleast_1d, _require_integers(_read_array(path), path))
        table = [tuple(rows.tolist()) for rows in per_query]
    if table and num_database > 2 and all(len(rows) == num_database and {*rows} <= {0, 1} for rows in table):
        raise InputError(f"{path}: expected rows of the database, got flags for each of them; get the file again")
    for query, rows in enumerate(table):
        if rows and not 0 <= min(rows) <= max(rows) < num_database:
            raise InputError(f"{path}: query {query}: expected rows from 0 to {num_database - 1}, got "
                             f"{min(rows)} to {max(rows)}")  # fmt: skip
    return table


def _require_integers(rows: np.ndarray, path: Path) -> np.ndarray:
    if rows.dtype.kind not in "iu" or rows.ndim > 2:
        raise InputError(f"{path}: expected lists of rows, got {rows.dtype} {list(rows.shape)}")
    return rows


def _read_array(path: Path) -> np.ndarray:
    with reading(path, "a list", "expected an array of NumPy; get it again"), path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False)
