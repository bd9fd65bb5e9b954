"""Read and write NumPy archives: one file for all images, or a folder with one for each image."""

import io
import math
import os
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Shaped

from mfvpr.io.containers import MAX_INFLATED, Container, FileEntry, Shapes, reading, require_plain, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_replaceable

SUFFIXES = (".npz", ".d2-net")  # of files in a folder; D2-Net's code writes `.d2-net`


class NpzFile(Container):
    """Reader of one archive for all images, with arrays named `image/part`: `a/1.jpg/keypoints`.

    Every call reads the directory, which takes half a second for 10,000 images: request many images at once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _open_archive(path) as archive:
            members = [name.removesuffix(".npy") for name in archive.namelist()]
        self.images = tuple(dict.fromkeys(name.rpartition("/")[0] for name in members if "/" in name))
        if not self.images:
            got = shorten(", ".join(members)) or "none"
            raise InputError(f"{path}: expected arrays named by images (a.jpg/keypoints), got {got}; "
                             "if every image has its own file, give their folder")  # fmt: skip

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        with _open_archive(self.path) as archive:
            members: dict[str, set[str]] = defaultdict(set)
            for name in archive.namelist():
                image, _, part = name.rpartition("/")
                members[image].add(part)
            for image in images:
                yield _shapes(archive, members[image], f"{image}/", parts)

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        with _open_archive(self.path) as archive:
            members = set(archive.namelist())
            for image in images:
                names = {part: f"{image}/{part}.npy" for part in parts}
                yield {part: _array(archive, name) for part, name in names.items() if name in members}


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
            with _open_archive(self._paths[image]) as archive:
                yield _shapes(archive, archive.namelist(), "", parts)

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        for image in images:
            yield read_npz(self._paths[image], parts)

    def entry(self, image: str) -> FileEntry:
        return FileEntry(self._paths[image], "")


def read_npz(path: Path, parts: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the arrays of an archive among `parts`, and no others; InputError if it is damaged, or holds objects."""
    with _open_archive(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
        return {part: _array(archive, members[part]) for part in parts if part in members}


def write_npz(path: Path, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write a new file of named arrays, one after the other, atomically."""
    require_replaceable(path)
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays:
            with archive.open(f"{printable(name)}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


@contextmanager
def _open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; raise an InputError if two members share a name, since readers choose either."""
    with reading(path), zipfile.ZipFile(path) as archive:
        if twice := [name for name, count in Counter(archive.namelist()).items() if count > 1]:
            raise InputError(f"{path}: expected every array once, got {shorten(twice[0])} again; write the file anew")
        yield archive


def _shapes(archive: zipfile.ZipFile, members: Iterable[str], prefix: str, parts: Sequence[str]) -> Shapes:
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys((name.removesuffix(".npy") for name in members), ())
    for part in parts:
        if part in shapes:
            with archive.open(f"{prefix}{part}.npy") as file:
                shapes[part] = _read_header(f"{archive.filename}: {shorten(prefix + part)}.npy", file)[0]
    return shapes


def _read_header(where: str, file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in readers:
        raise InputError(f"{where}: expected an array of NumPy's format 1.0 or 2.0, got {version}")
    shape, _, dtype = readers[version](file)
    require_plain(where, dtype)
    return shape, dtype


def _array(archive: zipfile.ZipFile, member: str) -> np.ndarray:
    where, entry = f"{archive.filename}: {shorten(member)}", archive.getinfo(member)
    if entry.file_size > max(MAX_INFLATED, entry.compress_size):
        raise InputError(f"{where}: expected at most 1 GiB in a compressed array, got more; write it uncompressed")
    return parse_npy(where, archive.read(member))  # completely, which verifies the checksum


def parse_npy(where: str, content: bytes) -> Shaped[np.ndarray, "..."]:
    """The array in the bytes of a `.npy`; raise an InputError if bytes are missing or left over."""
    file = io.BytesIO(content)
    shape, dtype = _read_header(where, file)
    expected = math.prod(shape) * dtype.itemsize
    if expected != len(content) - file.tell():
        raise InputError(f"{where}: expected {expected} bytes of values, got {len(content) - file.tell()}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _files_below(root: Path) -> Iterator[Path]:
    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be listed ({error.strerror}); make it readable") from None

    for folder, folders, files in os.walk(root, onerror=refuse, followlinks=False):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if name.endswith(SUFFIXES) and not name.startswith("."):
                yield Path(folder, name)
