"""What image files hold, remembered from run to run, so that nothing is read again that has not changed.

A file's content decides, never its name or its age: a record is trusted only where path, size, both times and number of
the file are what they were, and only if the times were old enough when it was read: a file that is written twice within
one tick of the clock keeps them.
"""

import hashlib
import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import astuple, dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.images import read_header
from mfvpr.utils.files import IMAGE_SUFFIXES, write_text
from mfvpr.utils.threads import ordered_map

FORMAT = 2  # of the records: raise it when they change
SETTLED = 2_000_000_000  # ns; the coarsest clock of a file system (FAT) ticks every two seconds


@dataclass(frozen=True)
class Content:
    """One file.

    Attributes:
        sha256: of all bytes; "" = it cannot be read.
        orientation: see `mfvpr.datasets.images.Header`.
        largest: see there.
    """

    sha256: str = ""
    orientation: int = 1
    largest: int | None = None


@dataclass(frozen=True)
class Contents:
    """The files of a folder, in its order."""

    folder: ImageFolder
    files: tuple[Content, ...]

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over names, contents and what reading does to them; the first 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for name, file in zip(self.folder.names, self.files, strict=True):
            content = bytes.fromhex(file.sha256) if file.sha256 else b"unreadable"
            digest.update(name.encode("utf-8", "surrogateescape") + b"\0" + content)
            if self.folder.orient and file.orientation != 1:
                digest.update(b"\0turned")
            if file.largest is not None:
                digest.update(f"\0bits={self.folder.bits}".encode())
        return digest.hexdigest()[:16]

    @cached_property
    def sha256(self) -> str:
        """Over the contents alone, whatever the files are called; the first 16 hexadecimal digits."""
        return hashlib.sha256("".join(file.sha256 for file in self.files).encode()).hexdigest()[:16]

    def summary(self) -> dict[str, int | bool | None]:
        """What reading does to the images, for people and results."""
        tagged = sum(file.orientation != 1 for file in self.files)
        deep = [file.largest for file in self.files if file.largest is not None]
        return {
            "orient": self.folder.orient,
            "turned": tagged if self.folder.orient else 0,
            "bits": self.folder.bits,
            "scaled_16bit": len(deep) if self.folder.bits is not None else 0,
            "largest_16bit": max(deep, default=None),
        }


def contents(folder: ImageFolder, cache: Path | str | None = None) -> Contents:
    """What the files of `folder` hold.

    Args:
        folder: images.
        cache: folder in which it is remembered; None = everything is read. A record that is damaged, or that another
            process replaces meanwhile, costs time only.
    """
    root = folder.root.absolute()
    record = None if cache is None else Path(cache) / f"{hashlib.sha256(os.fsencode(root)).hexdigest()[:32]}.json"
    known, begun = {} if record is None else _recalled(record), time.time_ns()
    states = dict(zip(folder.names, map(state_of, folder.paths), strict=True))
    trusted = {name for name, state in states.items() if state and name in known and known[name][:4] == state}
    changed = [name for name in folder.names if name not in trusted]
    read = ordered_map(read_content, [folder.root / name for name in changed], workers=2)
    files = {name: Content(*known[name][4:]) for name in trusted} | dict(zip(changed, read, strict=True))
    if record is not None and changed:  # other files of this folder, which another data set asks for, stay known
        settled = {name: state for name, state in states.items() if state and max(state[1:3]) < begun - SETTLED}
        _remember(record, known | {name: [*state, *astuple(files[name])] for name, state in settled.items()})
    return Contents(folder, tuple(files[name] for name in folder.names))


def files_of(path: PurePath) -> ImageFolder:
    """A file, or all files below a folder, as what contents are known of."""
    path = Path(path)
    names = [file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()]
    return ImageFolder(path, tuple(sorted(names))) if path.is_dir() else ImageFolder(path.parent, (path.name,))


def state_of(path: Path | str) -> list[int] | None:
    """Size, when content and entry last changed (ns), and the number of the file, which moves along with it.

    None where there is no file.
    """
    try:
        status = os.stat(path)
    except OSError:
        return None
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]


def read_content(path: Path) -> Content:
    try:
        if not path.is_file():  # a pipe would keep us waiting
            return Content()
        if path.suffix.lower() not in IMAGE_SUFFIXES:  # no image, and perhaps larger than the memory
            with path.open("rb") as file:
                return Content(hashlib.file_digest(file, "sha256").hexdigest())
        content = path.read_bytes()
    except OSError:
        return Content()  # whoever reads the image will tell
    header = read_header(content)
    return Content(hashlib.sha256(content).hexdigest(), header.orientation, header.largest)


def _recalled(record: Path) -> dict[str, list[Any]]:
    """By name: the state of the file, and its Content. Empty where there is no record, or a damaged one."""
    try:
        check, _, text = record.read_text(encoding="ascii").partition("\n")
    except (OSError, UnicodeError):
        return {}
    return json.loads(text) if check == _check(text) else {}


def _remember(record: Path, files: Mapping[str, Any]) -> None:
    text = json.dumps(files, separators=(",", ":"))  # ASCII: file names may be no UTF-8
    with suppress(OSError):  # it would only have saved time
        write_text(record, f"{_check(text)}\n{text}")


def _check(text: str) -> str:
    return f"{FORMAT} {hashlib.sha256(text.encode('ascii')).hexdigest()}"
