"""Hashes and largest values of image files, remembered between runs, so that unchanged files are not read again.

A file is unchanged if its path, size, both times and inode number are, and if the times were old enough when it was
read: a file that is written twice within one tick of the clock keeps its times.
"""

import hashlib
import json
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import astuple, dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

from mfvpr.datasets.datasets import IdenticalRows, ImageFolder
from mfvpr.datasets.image_reading import largest_16bit
from mfvpr.utils.files import IMAGE_SUFFIXES, write_text
from mfvpr.utils.runtime import ordered_map

FORMAT = 3  # of the record files: raise it when they change
SETTLED = 2_000_000_000  # ns; the coarsest clock of a file system (FAT) ticks every two seconds


@dataclass(frozen=True)
class Content:
    """Hash and largest value of one file."""

    sha256: str = ""  # of all bytes; "" = the file cannot be read
    largest: int = 0  # see `largest_16bit`


@dataclass(frozen=True)
class Contents:
    """The contents of a folder's files, in its order."""

    folder: ImageFolder
    files: tuple[Content, ...]
    masks: tuple[Content, ...] = ()  # of each image, if the folder has masks

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over names, contents, masks and conversions; the first 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for name, pixels in zip(self.folder.names, self._pixels(), strict=True):
            digest.update(name.encode("utf-8", "surrogateescape") + b"\0" + pixels)
        return digest.hexdigest()[:16]

    @property
    def keys(self) -> list[str]:
        """SHA-256 of each image's content, mask and conversions; the first 32 hexadecimal digits."""
        return [hashlib.sha256(pixels).hexdigest()[:32] for pixels in self._pixels()]

    def _pixels(self) -> Iterator[bytes]:
        ways = self.folder.orient, self.folder.bits
        conversion = b"" if ways == (True, 16) else f"\0{ways}".encode()
        for row, file in enumerate(self.files):
            content = bytes.fromhex(file.sha256) if file.sha256 else b"unreadable"
            yield content + conversion + (f"\0{self.masks[row].sha256}".encode() if self.masks else b"")

    @cached_property
    def sha256(self) -> str:
        """SHA-256 over the contents without names; the first 16 hexadecimal digits."""
        return hashlib.sha256("".join(file.sha256 for file in self.files).encode()).hexdigest()[:16]


def contents(folder: ImageFolder, cache: Path | str | None = None) -> Contents:
    """The contents of the files of `folder`, `contents(mfvpr.datasets.image_folder("day/")).fingerprint`.

    `cache` is the folder of the record files; None = all files are read. A damaged record file costs time only.
    """
    root = folder.root.absolute()
    name = f"{hashlib.sha256(os.fsencode(root)).hexdigest()[:32]}-{FORMAT}.json"
    path = None if cache is None else Path(cache) / name
    records: dict[str, list[Any]] = {}  # state and content of files by name
    start = time.time_ns()
    with suppress(OSError, ValueError):  # missing or damaged
        records = {} if path is None else json.loads(path.read_text(encoding="ascii"))
    states = dict(zip(folder.names, map(state_of, folder.paths), strict=True))
    changed = [name for name, state in states.items() if not state or records.get(name, [])[:4] != state]
    new = ordered_map(read_content, [folder.root / name for name in changed], workers=2)
    files = dict(zip(changed, new, strict=True))
    files |= {name: Content(*records[name][4:]) for name in states if name not in files}
    if path is not None and changed:  # records of other files of this folder, from other data sets, stay
        settled = {name: state for name, state in states.items() if state and max(state[1:3]) < start - SETTLED}
        records |= {name: [*state, *astuple(files[name])] for name, state in settled.items()}
        with suppress(OSError):  # records only save time
            write_text(path, json.dumps(records, separators=(",", ":")))  # ASCII: file names may be no UTF-8
    masks = () if folder.mask_files is None else contents(folder.mask_files, cache).files
    return Contents(folder, tuple(files[name] for name in folder.names), masks)


def fingerprints(contents: Mapping[str, Contents]) -> dict[str, str]:
    """Fingerprints of folders by side, as results store them."""
    return {side: folder.fingerprint for side, folder in contents.items()}


def identical_rows(queries: Contents, database: Contents) -> IdenticalRows:
    """For each of the `queries`, the rows of files in the `database` with the same content."""
    rows = defaultdict(list)
    for row, file in enumerate(database.files):
        rows[file.sha256].append(row)
    rows[""] = []  # files that cannot be read
    return tuple(tuple(rows.get(file.sha256, ())) for file in queries.files)


def files_of(path: PurePath) -> ImageFolder:
    """A file, or all files below a folder, as a folder for `contents`."""
    path = Path(path)
    names = [file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()]
    return ImageFolder(path, tuple(sorted(names))) if path.is_dir() else ImageFolder(path.parent, (path.name,))


def state_of(path: Path | str) -> list[int] | None:
    """Size, times of the last change of content and of entry (ns), and inode number; None if there is no file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def read_content(path: Path) -> Content:
    try:
        if not path.is_file():  # a pipe would block
            return Content()
        if path.suffix.lower() not in IMAGE_SUFFIXES:  # perhaps larger than the memory
            with path.open("rb") as file:
                return Content(hashlib.file_digest(file, "sha256").hexdigest())
        content = path.read_bytes()
    except OSError:
        return Content()  # reading the image raises
    return Content(hashlib.sha256(content).hexdigest(), largest_16bit(content))
