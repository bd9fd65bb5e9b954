"""Arrays by image and name in files of other programs: hloc's h5, npz, folders of npz. Read as data, never executed."""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from mfvpr.utils.errors import InputError


class Contents(NamedTuple):
    """What there is of an image: the names of its arrays, and the shapes of some."""

    names: Set[str]
    shapes: Mapping[str, tuple[int, ...]]


class FileEntry(NamedTuple):
    """Place of an image's arrays.

    Attributes:
        file: that holds the arrays.
        name: of the image in the file; "" = the file holds one image.
    """

    file: Path
    name: str


class Container(Protocol):
    """Arrays of several images; only what is asked for is read.

    Attributes:
        path: file or folder, for messages.
        images: what the file calls its images.
        transposed: whether descriptors are `[D, N]` where their shape cannot tell.
    """

    path: Path
    images: tuple[str, ...]
    transposed: bool

    def contents(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Contents]:
        """For each image, what there is, and the shapes of those of its `parts` that are there; no values are read."""
        ...

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        """For each image, those of its `parts` that are there."""
        ...

    def entry(self, image: str) -> FileEntry:
        """Place of an image's arrays."""
        ...


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever goes wrong with a foreign file is one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # what damaged bytes can raise in zipfile, zlib, NumPy and HDF5 has no common class
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read ({shortened(reason, 160)}); is it whole, and of this kind?") from None


def shortened(text: str, limit: int = 60) -> str:
    """Foreign text, for a message of one line."""
    text = text.encode("unicode_escape").decode("ascii") if not text.isprintable() else text
    return text if len(text) <= limit else f"{text[: limit - 20]}... ({len(text)} characters)"


def require_plain(where: str, dtype: np.dtype) -> None:
    """Refuse arrays of Python objects, which only a pickle could bring, and of records."""
    if dtype.hasobject or dtype.kind in "OV":
        raise InputError(
            f"{where}: expected an array of numbers or text, got objects or records; they are never loaded"
        )
