"""Atomic writes, locks of folders, and checks of paths and names of files."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from mfvpr.utils.errors import InputError

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` (same suffix) that replaces it when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.fchmod(handle, 0o644)  # mkstemp's 0600 would surprise whoever shares the folder
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def lock_folder(folder: Path, error: Exception | None) -> Iterator[None]:
    """Hold the lock of an existing folder; if it is held elsewhere, raise the error, or wait for it without one.

    `flock` needs no file, ends with its process, and holds between threads as well.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX if error is None else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as held:
            raise error or held from None
        yield
    finally:
        os.close(handle)


def require_file(path: Path, expected: str = "a file") -> None:
    """Raise `InputError` if a path is no regular file: a pipe would block its reader forever."""
    if not path.is_file():
        got = "a folder" if path.is_dir() else "a pipe or device" if path.exists() else "nothing"
        raise InputError(f"{path}: expected {expected}, got {got}; check the path")


def require_replaceable(path: Path, mark: bytes | None = None) -> None:
    """Raise `InputError` if a file exists, unless its first 4 KiB contain `mark`, as all earlier outputs do."""
    if os.path.lexists(path):
        if mark is not None and path.is_file():
            with path.open("rb") as file:
                if mark in file.read(4096):
                    return
        raise InputError(f"{path}: expected a new file, got one that exists; remove it, or name another")


def printable(text: str) -> str:
    """`text` for UTF-8: characters that it lacks, of names in other encodings, as \\udcXX, which JSON reads back."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def clip_middle(text: str, most: int) -> str:
    """`text` of at most `most` characters, without its middle."""
    half = (most - 1) // 2
    return text if len(text) <= most else f"{text[:half]}\N{HORIZONTAL ELLIPSIS}{text[-half:]}"


def write_text(path: Path, text: str) -> None:
    """Write `printable` text as UTF-8, atomically."""
    with replacing(path) as temporary:
        temporary.write_text(printable(text), encoding="utf-8")


def read_yaml(path: Path) -> Any:
    """The values of a YAML file that belongs to this library."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's, if it is there, is eight times as fast
    return yaml.load(path.read_text(encoding="utf-8"), loader)


def canonical_name(path: Path | str) -> str:
    """Absolute path, the same for every spelling: links to folders are followed, a link to a file is not."""
    path = Path(path)
    return str(path.parent.resolve() / path.name)


def path_inside(root: Path, name: str) -> Path:
    """The path of a name from elsewhere below a folder; an InputError if the name leads out, also by a link."""
    with suppress(OSError, RuntimeError, ValueError):  # links in a circle, a character that no name has
        if (path := (root / name).resolve()).is_relative_to(root.resolve()):
            return path
    raise InputError(
        f"{clip_middle(name, 200)!r}: expected the name of a file below {root}, got one that leads elsewhere"
    )


def expand_user(path: str) -> Path:
    """A path with ~ replaced by the home folder."""
    return Path(os.path.expanduser(path))
