"""Files with arrays by image: hloc's HDF5, NumPy's archives, folders of archives; their numbers, and messages."""

import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Shaped

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_file, require_replaceable

MAX_INFLATED = 1 << 30  # bytes of an array that a file stores compressed
SUFFIXES = (".npz", ".d2-net")  # of files in a folder; D2-Net's code writes `.d2-net`


class FileEntry(NamedTuple):
    """Place of an image's arrays."""

    file: Path
    name: str  # of the image in the file; "" = the file holds one image


class H5File:
    """An hloc file: images are the groups that hold datasets, named by their relative paths.

    Attributes:
        path: of the file, for messages.
        entries: place of each image's arrays, by its name in the file.
        transposed: whether descriptors are `[D, N]` if their shapes fit both layouts.
    """

    transposed = True

    def __init__(self, path: Path) -> None:
        self.path, names = path, list[str]()
        with self._open() as file:
            file.visit(names.append)  # follows no links
        groups = {name.rpartition("/")[0] for name in names}
        images = (name.rpartition("/")[0] for name in names if name not in groups)
        self.entries = {image: FileEntry(path, image) for image in images if image}
        if not self.entries:
            raise InputError(f"{path}: expected a group for every image, as hloc writes them, got no datasets")

    def read(self, images: Iterable[str], parts: Sequence[str], *, shapes: bool = False) -> Iterator[dict[str, Any]]:
        """For each image, its arrays among `parts`; their shapes alone, without reading values, if `shapes`."""
        with self._open() as file:
            for image in images:
                group = file[image]
                datasets = {part: self._dataset(file, group, image, part) for part in parts if part in group}
                yield {part: dataset.shape if shapes else dataset[()] for part, dataset in datasets.items()}

    def _dataset(self, file: Any, group: Any, image: str, part: str) -> Any:
        dataset, where = group[part], f"{self.path}: {shorten(image)}/{part}"
        has_values = getattr(dataset, "shape", None) is not None and not dataset.external and not dataset.is_virtual
        is_here = has_values and dataset.file.filename == file.filename
        stored = dataset.id.get_storage_size() if is_here else 0
        if not is_here or (dataset.size and not stored):  # HDF5 would read zeros
            got = "none, a group or a link; copy linked data into the file, or extract this image again"
            raise InputError(f"{where}: expected data in this file, got {got}")
        if dataset.nbytes > max(MAX_INFLATED, stored):
            raise InputError(f"{where}: expected at most 1 GiB in a compressed dataset; write it uncompressed")
        return dataset

    @contextmanager
    def _open(self) -> Iterator[Any]:
        with reading(self.path), _h5py(self.path).File(self.path, "r") as file:
            yield file


class NpzFiles:
    """One archive for all images, or a folder with an archive for each image; attributes as of `H5File`.

    In one archive, arrays are named `image/part`: `a/1.jpg/keypoints`. Every call reads its directory, which takes half
    a second for 10,000 images: request many images at once. In a folder, files are `a/1.jpg.npz` or `a/1.jpg.d2-net`;
    hidden files and folders are skipped, and links to folders are not followed.
    """

    transposed = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, FileEntry] = {}
        if path.is_dir():
            for file in sorted(path.rglob("*")):
                inside = file.relative_to(path)
                if file.suffix not in SUFFIXES or any(part.startswith(".") for part in inside.parts):
                    continue
                other = self.entries.setdefault(inside.as_posix().removesuffix(file.suffix), FileEntry(file, "")).file
                if other != file:
                    raise InputError(f"{file}: {other.name} beside it is of the same image; remove either")
        else:
            with _open_npz(path) as archive:
                images = (name.rpartition("/")[0] for name in archive.files)
                self.entries = {image: FileEntry(path, image) for image in images if image}
        if not self.entries:
            expected = f"arrays named by images (a.jpg/keypoints), or a folder of files {' or '.join(SUFFIXES)}"
            raise InputError(f"{path}: expected {expected}, got none")

    def read(self, images: Iterable[str], parts: Sequence[str], *, shapes: bool = False) -> Iterator[dict[str, Any]]:
        """As `H5File.read`."""
        for file, entries in groupby((self.entries[image] for image in images), key=lambda entry: entry.file):
            with _open_npz(file) as archive:
                known = {*archive.files}
                for entry in entries:
                    names = {part: f"{entry.name}/{part}" if entry.name else part for part in parts}
                    yield {part: _read(archive, name, shapes) for part, name in names.items() if name in known}


def read_npz(path: Path, parts: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the arrays of an archive among `parts`, and no others; InputError if it is damaged, or holds objects."""
    with _open_npz(path) as archive:
        return {part: _read(archive, part) for part in parts if part in archive}


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write a new file of named arrays, one after the other, atomically."""
    require_replaceable(path)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays:
            with archive.open(f"{printable(name)}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def write_h5(path: Path, groups: Iterable[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """Write a new file with a group for each image, one after the other, atomically; `libver` as in hloc."""
    require_replaceable(path)
    with replacing(path) as temporary, _h5py(path).File(temporary, "w", libver="latest") as file:
        for image, parts in groups:
            group = file.create_group(printable(image))
            for part, array in parts.items():
                group.create_dataset(part, data=array)


def read_npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the order is Fortran's, and type of an array of NumPy's; the file is then at its values."""
    is_first = np.lib.format.read_magic(file) == (1, 0)
    return (np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0)(file)


def choose_reader(path: Path, readers: Mapping[str, Callable]) -> Callable:
    """The reader for a file's suffix; raise an InputError for a path that is no file, or has another suffix."""
    require_file(path)
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a file named {', '.join(readers)}, got {path.suffix or 'no suffix'}")
    return readers[path.suffix.lower()]


@contextmanager
def reading(path: Path, kind: str = "a file", mend: str = "is it whole, and of this kind?") -> Iterator[None]:
    """Require a regular file, and turn any error of its reader into an InputError of one line with the path."""
    try:
        require_file(path, kind)
        yield
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception as error:  # zipfile, zlib, NumPy, HDF5 and decoders of images share no class of errors
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read ({shorten(reason, 160)}); {mend}") from None


def shorten(text: str, limit: int = 60) -> str:
    """Text of a file in at most `limit` printable characters, for messages."""
    start = text[: limit + 1]
    start = start if start.isprintable() else start.encode("unicode_escape").decode("ascii")
    return start if len(start) <= limit else f"{start[: limit - 20]}... ({len(text)} characters)"


def parse_number(text: str) -> float:
    """The number in a text, as C writes it, or a `ValueError`; Python's own `float` also reads `1_0` as 10."""
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def as_float32(where: str, array: Shaped[np.ndarray, "..."], kinds: str = "f") -> Float32[np.ndarray, "..."]:
    """Convert an array of these kinds of numbers (`numpy.dtype.kind`) to float32; InputError for others."""
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.ascontiguousarray(array, np.float32) if array.dtype.kind in kinds else None
    if values is None or not np.isfinite(values).all():
        got = array.dtype if values is None else f"{array[~np.isfinite(values)][0]}; extract it again"
        raise InputError(f"{where}: expected finite {'floating-point ' * (kinds == 'f')}numbers of float32, got {got}")
    return values


@contextmanager
def _open_npz(path: Path) -> Iterator[Any]:
    with reading(path), path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InputError("expected an archive of NumPy (.npz), got an array")
        with archive:
            yield archive


def _read(archive: Any, name: str, shape: bool = False) -> Any:
    entry = archive.zip.getinfo(f"{name}.npy")
    if shape:
        with archive.zip.open(entry) as file:
            return read_npy_header(file)[0]
    if entry.file_size > max(MAX_INFLATED, entry.compress_size):
        raise InputError(f"{shorten(name)}: expected at most 1 GiB in a compressed array; write it uncompressed")
    return np.asarray(archive[name])


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: HDF5 needs the package h5py; pip install 'mfvpr[hloc]'") from None
    return h5py
