"""Common interface of files with arrays by image: hloc's h5, npz, folders of npz."""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from mfvpr.utils.errors import InputError


class Contents(NamedTuple):
    """Names of an image's arrays, and shapes of the requested ones."""

    names: Set[str]
    shapes: Mapping[str, tuple[int, ...]]


class FileEntry(NamedTuple):
    """Place of an image's arrays.

    Attributes:
        file: file with the arrays.
        name: name of the image in the file; "" = the file holds one image.
    """

    file: Path
    name: str


class Container(Protocol):
    """Arrays of several images; reads only the requested arrays.

    Attributes:
        path: file or folder, for messages.
        images: names of the images in the file.
        transposed: whether descriptors are `[D, N]` if their shapes fit both layouts.
    """

    path: Path
    images: tuple[str, ...]
    transposed: bool

    def contents(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Contents]:
        """For each image, the names of all arrays and the shapes of those in `parts`; reads no values."""
        ...

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        """For each image, its arrays among `parts`."""
        ...

    def entry(self, image: str) -> FileEntry:
        """Place of an image's arrays."""
        ...


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn any error of a reader into an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and HDF5 share no class of errors
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read ({shorten(reason, 160)}); is it whole, and of this kind?") from None


def shorten(text: str, limit: int = 60) -> str:
    """Text of a file in at most `limit` printable characters, for messages."""
    text = text.encode("unicode_escape").decode("ascii") if not text.isprintable() else text
    return text if len(text) <= limit else f"{text[: limit - 20]}... ({len(text)} characters)"


def require_plain(where: str, dtype: np.dtype) -> None:
    """Raise an InputError for arrays of Python objects, which need a pickle, and of records."""
    if dtype.hasobject or dtype.kind in "OV":
        raise InputError(f"{where}: expected an array of numbers or text, got objects or records, which are not loaded")
