"""Common interface of files with arrays by image: hloc's h5, npz, folders of npz."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file

MAX_INFLATED = 1 << 30  # bytes of an array that a file stores compressed
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
