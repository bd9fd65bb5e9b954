"""Read and write NumPy archives: one file for all images, or a folder with one for each image."""

import os
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.io.containers import MAX_INFLATED, Container, FileEntry, Shapes, reading, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_replaceable

SUFFIXES = (".npz", ".d2-net")  # of files in a folder; D2-Net's code writes `.d2-net`


class NpzFile(Container):
    """Reader of one archive for all images, with arrays named `image/part`: `a/1.jpg/keypoints`.

    Every call reads the directory, which takes half a second for 10,000 images: request many images at once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _open(path) as archive:
            names = archive.files
        self.images = tuple(dict.fromkeys(name.rpartition("/")[0] for name in names if "/" in name))
        if not self.images:
            raise InputError(
                f"{path}: expected arrays named by images (a.jpg/keypoints), got {shorten(', '.join(names)) or 'none'};"
                " if every image has its own file, give their folder"
            )

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        with _open(self.path) as archive:
            members = defaultdict(list)
            for name in archive.files:
                image, _, part = name.rpartition("/")
                members[image].append(part)
            for image in images:
                yield _shapes(archive, members[image], f"{image}/", parts)

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        with _open(self.path) as archive:
            for image in images:
                names = {part: f"{image}/{part}" for part in parts}
                yield {part: _read(archive, name) for part, name in names.items() if name in archive}


class NpzFolder(Container):
    """Reader of a folder with an archive for each image: `a/1.jpg.npz` or `a/1.jpg.d2-net`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._paths: dict[str, Path] = {}
        for file in sorted(_files_below(path)):
            image = file.relative_to(path).as_posix().removesuffix(file.suffix)
            if image in self._paths:
                raise InputError(f"{file}: {self._paths[image].name} beside it is of the same image; remove either")
            self._paths[image] = file
        self.images = tuple(self._paths)
        if not self.images:
            raise InputError(f"{path}: expected files named {' or '.join(SUFFIXES)}, got none; check the path")

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        for image in images:
            with _open(self._paths[image]) as archive:
                yield _shapes(archive, archive.files, "", parts)

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        for image in images:
            yield read_npz(self._paths[image], parts)

    def entry(self, image: str) -> FileEntry:
        return FileEntry(self._paths[image], "")


def read_npz(path: Path, parts: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the arrays of an archive among `parts`, and no others; InputError if it is damaged, or holds objects."""
    with _open(path) as archive:
        return {part: _read(archive, part) for part in parts if part in archive}


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write a new file of named arrays, one after the other, atomically."""
    require_replaceable(path)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays:
            with archive.open(f"{printable(name)}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    with reading(path), path.open("rb") as file:
        archive = np.load(file, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InputError("expected an archive of NumPy (.npz), got an array")
        with archive:
            yield archive


def _shapes(archive: Any, names: Iterable[str], prefix: str, parts: Sequence[str]) -> Shapes:
    return {name: _shape(archive, prefix + name) if name in parts else () for name in names}


def _shape(archive: Any, name: str) -> tuple[int, ...]:
    with archive.zip.open(f"{name}.npy") as file:
        is_first = np.lib.format.read_magic(file) == (1, 0)
        read = np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0
        return read(file)[0]


def _read(archive: Any, name: str) -> np.ndarray:
    entry = archive.zip.getinfo(f"{name}.npy")
    if entry.file_size > max(MAX_INFLATED, entry.compress_size):
        raise InputError(f"{shorten(name)}: expected at most 1 GiB in a compressed array; write it uncompressed")
    return np.asarray(archive[name])


def _files_below(root: Path) -> Iterator[Path]:
    """Files of features, without hidden files and folders; links to folders are not followed."""
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(folder, name) for name in files if name.endswith(SUFFIXES) and not name.startswith("."))
