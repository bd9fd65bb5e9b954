"""Read and write global descriptors of other programs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mfvpr.core.types import Array
from mfvpr.io.checks import Lengths, as_float32, convert_floats, with_length
from mfvpr.io.containers import FileEntry, H5File, choose_reader, read_npz, reading, shorten, write_h5, write_npz
from mfvpr.io.names import match_names, require_all, require_different
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.files import printable, replacing, require_replaceable

PART = "global_descriptor"  # hloc's name


def read_global_descriptors(
    path: Path | str, names: Sequence[str], *, lengths: Lengths = "unit"
) -> Float32[np.ndarray, "images dimensions"]:
    """Global descriptors of the images `names`.

    Args:
        path: `.npy`: `[M, D]`, in the order of the names as Python sorts them (image10 before image2), such as
            VPR-methods-evaluation's `database_descriptors.npy`;
            `.npz`: `descriptors` `[M, D]` and `names` `[M]`; without `names`, the order of `.npy`;
            `.h5` or `.hdf5`: as hloc, a `global_descriptor` `[D]` for each image.
        names: `[M]` relative POSIX paths, matched as in `names.match_names`.
        lengths: as in `open_features`.

    Returns:
        `[M, D]` float32 in the order of `names`.

    Raises:
        InputError: the file is missing or damaged; images are missing or ambiguous; values are not finite; or lengths
            are not 1.
    """
    return read_with_entries(path, names, lengths=lengths)[0]


def read_with_entries(
    path: Path | str, names: Sequence[str], *, lengths: Lengths = "unit"
) -> tuple[Float32[np.ndarray, "images dimensions"], list[FileEntry]]:
    """Descriptors as `read_global_descriptors` returns them, and `[M]` the entry of each image."""
    path = Path(path)
    require_word("lengths", lengths, Lengths)
    kind = choose_reader(path, {".npy": np.load, ".npz": read_npz, ".h5": H5File, ".hdf5": H5File})
    if kind is H5File:
        values, entries = _read_h5(H5File(path), names)
    else:
        if kind is np.load:
            with reading(path):
                arrays = {"descriptors": np.load(path, allow_pickle=False)}
        else:
            arrays = read_npz(path, ("descriptors", "names"))
        if "descriptors" not in arrays:
            raise InputError(f"{path}: expected an array descriptors [M, D], and names [M]; got no descriptors")
        values, file_names = arrays["descriptors"], arrays.get("names")
        if file_names is None:
            _require_rows(path, values, names)
            rows = np.argsort(_sorted_rows(names)).tolist()
            entries = [f"row {row}" for row in rows]
        else:
            if file_names.dtype.kind != "U" or file_names.shape != values.shape[:1]:
                got = f"{file_names.dtype}{list(file_names.shape)} and {list(values.shape)}"
                raise InputError(f"{path}: expected names as text [M] and descriptors [M, D], got {got}")
            require_different(path, file_names.tolist())
            places = {name: row for row, name in enumerate(file_names.tolist())}
            entries = require_all(path, names, match_names(path, names, places), "descriptors")
            rows = [places[entry] for entry in entries]
        values = values[rows]
    _require_rows(path, values, names)
    values = with_length(str(path), as_float32(str(path), values), lengths)
    return values, [FileEntry(path, entry) for entry in entries]


def write_global_descriptors(
    path: Path | str, names: Sequence[str], descriptors: Float[Array, "images dimensions"], *, half: bool = False
) -> None:
    """Write global descriptors `[M, D]` as `read_global_descriptors` reads them, atomically.

    Args:
        path: new file, `.npy`, `.npz`, `.h5` or `.hdf5`.
        names: `[M]`.
        descriptors: `[M, D]` in the order of `names`.
        half: float16 instead of float32, as hloc by default.
    """
    path = Path(path)
    require_different(path, names)
    values = convert_floats(str(path), np.asarray(descriptors), half)
    _require_rows(path, values, names)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        require_replaceable(path)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.lib.format.write_array(file, values[_sorted_rows(names)], allow_pickle=False)
    elif suffix == ".npz":
        write_npz(path, {"names": np.array([printable(name) for name in names]), "descriptors": values}.items())
    elif suffix in (".h5", ".hdf5"):
        write_h5(path, ((name, {PART: value}) for name, value in zip(names, values, strict=True)))
    else:
        raise InputError(f"{path}: expected a name that ends with .npy, .npz, .h5 or .hdf5")


def _read_h5(file: H5File, names: Sequence[str]) -> tuple[np.ndarray, list[str]]:
    images = require_all(file.path, names, match_names(file.path, names, file.images), "descriptors")
    rows = []
    for image, parts in zip(images, file.arrays(images, (PART,)), strict=True):
        if PART not in parts or parts[PART].shape != (rows[0] if rows else parts[PART].reshape(-1)).shape:
            got = list(parts[PART].shape) if PART in parts else "none"
            raise InputError(f"{file.path}: {shorten(image)}: expected {PART} [D], the same D for all, got {got}")
        rows.append(parts[PART])
    return np.stack(rows) if rows else np.zeros((0, 0), np.float32), images


def _require_rows(path: Path, descriptors: np.ndarray, names: Sequence[str]) -> None:
    if descriptors.ndim != 2 or len(descriptors) != len(names) or not descriptors.shape[1]:
        raise InputError(f"{path}: expected descriptors [{len(names)}, D] of the images, got {list(descriptors.shape)}")


def _sorted_rows(names: Sequence[str]) -> np.ndarray:
    """`[M]` rows that sort the names."""
    return np.array(sorted(range(len(names)), key=names.__getitem__), np.int64)
