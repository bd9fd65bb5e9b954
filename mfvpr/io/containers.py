"""Files with arrays by image: hloc's HDF5, NumPy's archives, folders of archives; and messages about damaged files."""

import os
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_file, require_replaceable

MAX_INFLATED = 1 << 30  # bytes of an array that a file stores compressed
SUFFIXES = (".npz", ".d2-net")  # of files in a folder; D2-Net's code writes `.d2-net`
Shapes = Mapping[str, tuple[int, ...]]  # by the name of the array


class FileEntry(NamedTuple):
    """Place of an image's arrays."""

    file: Path
    name: str  # of the image in the file; "" = the file holds one image


class Container:
    """Base class of readers of several images, which read only the requested arrays."""

    path: Path  # file or folder, for messages
    images: tuple[str, ...]  # their names in the file
    transposed = False  # whether descriptors are `[D, N]` if their shapes fit both layouts

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        """For each image, the shapes of its arrays among `parts`, and () for its other arrays; reads no values."""
        raise NotImplementedError

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        """For each image, its arrays among `parts`."""
        raise NotImplementedError

    def entry(self, image: str) -> FileEntry:
        """Place of an image's arrays."""
        return FileEntry(self.path, image)


class H5File(Container):
    """Reader of an hloc file, which is open only during a call.

    Images are the groups that hold datasets, named by their relative paths.
    """

    transposed = True

    def __init__(self, path: Path) -> None:
        self.path = path
        names: list[str] = []
        with self._open() as file:
            file.visit(names.append)  # follows no links
        groups = {name.rpartition("/")[0] for name in names}
        images = (name.rpartition("/")[0] for name in names if name not in groups)
        self.images = tuple(dict.fromkeys(filter(None, images)))
        if not self.images:
            raise InputError(f"{path}: expected a group for every image, as hloc writes them, got no datasets")

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        with self._open() as file:
            for image in images:
                group = file[image]
                yield {name: self._dataset(group, image, name).shape if name in parts else () for name in group}

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        with self._open() as file:
            for image in images:
                group = file[image]
                yield {part: self._dataset(group, image, part)[()] for part in parts if part in group}

    def _dataset(self, group: Any, image: str, part: str) -> Any:
        dataset, where = group[part], f"{self.path}: {shorten(image)}/{part}"
        has_values = getattr(dataset, "shape", None) is not None and not dataset.external and not dataset.is_virtual
        if not has_values or dataset.file.filename != group.file.filename:
            raise InputError(f"{where}: expected data in this file, got a group or a link; copy the data")
        stored = dataset.id.get_storage_size()
        if dataset.size and not stored:  # HDF5 would read zeros
            raise InputError(f"{where}: expected data, got a dataset that was not written; extract this image again")
        if dataset.nbytes > max(MAX_INFLATED, stored):
            raise InputError(f"{where}: expected at most 1 GiB in a compressed dataset; write it uncompressed")
        return dataset

    @contextmanager
    def _open(self) -> Iterator[Any]:
        with reading(self.path), _h5py(self.path).File(self.path, "r") as file:
            yield file


class NpzFile(Container):
    """Reader of one archive for all images, with arrays named `image/part`: `a/1.jpg/keypoints`.

    Every call reads the directory, which takes half a second for 10,000 images: request many images at once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _open_npz(path) as archive:
            names = archive.files
        self.images = tuple(dict.fromkeys(name.rpartition("/")[0] for name in names if "/" in name))
        if not self.images:
            raise InputError(
                f"{path}: expected arrays named by images (a.jpg/keypoints), got {shorten(', '.join(names)) or 'none'};"
                " if every image has its own file, give their folder"
            )

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        with _open_npz(self.path) as archive:
            members = defaultdict(list)
            for name in archive.files:
                image, _, part = name.rpartition("/")
                members[image].append(part)
            for image in images:
                yield {part: _shape(archive, f"{image}/{part}") if part in parts else () for part in members[image]}

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        with _open_npz(self.path) as archive:
            for image in images:
                names = {part: f"{image}/{part}" for part in parts}
                yield {part: _read(archive, name) for part, name in names.items() if name in archive}


class NpzFolder(Container):
    """Reader of a folder with an archive for each image: `a/1.jpg.npz` or `a/1.jpg.d2-net`.

    Hidden files and folders are skipped; links to folders are not followed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._paths: dict[str, Path] = {}
        for folder, folders, files in os.walk(path):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for file in (Path(folder, name) for name in sorted(files) if name.endswith(SUFFIXES) and name[0] != "."):
                image = file.relative_to(path).as_posix().removesuffix(file.suffix)
                if image in self._paths:
                    raise InputError(f"{file}: {self._paths[image].name} beside it is of the same image; remove either")
                self._paths[image] = file
        self.images = tuple(self._paths)
        if not self.images:
            raise InputError(f"{path}: expected files named {' or '.join(SUFFIXES)}, got none; check the path")

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        for image in images:
            with _open_npz(self._paths[image]) as archive:
                yield {name: _shape(archive, name) if name in parts else () for name in archive.files}

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        for image in images:
            yield read_npz(self._paths[image], parts)

    def entry(self, image: str) -> FileEntry:
        return FileEntry(self._paths[image], "")


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


@contextmanager
def _open_npz(path: Path) -> Iterator[Any]:
    with reading(path), path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InputError("expected an archive of NumPy (.npz), got an array")
        with archive:
            yield archive


def _shape(archive: Any, name: str) -> tuple[int, ...]:
    with archive.zip.open(f"{name}.npy") as file:
        return read_npy_header(file)[0]


def _read(archive: Any, name: str) -> np.ndarray:
    entry = archive.zip.getinfo(f"{name}.npy")
    if entry.file_size > max(MAX_INFLATED, entry.compress_size):
        raise InputError(f"{shorten(name)}: expected at most 1 GiB in a compressed array; write it uncompressed")
    return np.asarray(archive[name])


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: HDF5 needs the package h5py; pip install 'mfvpr[hloc]'") from None
    return h5py
