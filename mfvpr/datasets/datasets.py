"""Data sets: database images, query images, and ground truth."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mfvpr.datasets.ground_truth import CHOICES, KINDS, truth_by_order, truth_from_names
from mfvpr.datasets.images import read_image
from mfvpr.datasets.positives import Positives
from mfvpr.datasets.truth import Truth
from mfvpr.datasets.truth_files import truth_from_file, truth_from_labels
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES

FILES = {"index_file": "index", "database_labels": "label", "query_labels": "label"}  # and their ground truth
MEANS = ("mean", "pooled")  # names in results of the means over sequences, and over all of their queries


@dataclass(frozen=True)
class ImageFolder:
    """Images below `root`, by relative POSIX path in natural order (image2 before image10).

    `orient` and `bits` are those of `mfvpr.datasets.images.read_image`.
    """

    root: Path
    names: tuple[str, ...]
    orient: bool = True
    bits: int | None = 16

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", Path(self.root))

    @property
    def paths(self) -> list[Path]:
        """Full paths of the images, in order."""
        return [self.root / name for name in self.names]

    def __len__(self) -> int:
        return len(self.names)

    def read(self, row: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read one image; errors are those of `read_image`."""
        return read_image(self.root / self.names[row], orient=self.orient, bits=self.bits)


@dataclass(frozen=True)
class QuerySequence:
    """Query images of one drive or walk, with their ground truth; `name` stands in results.

    Attributes:
        truth: which database images are correct; None = no ground truth, rankings only.
        excluded: the database images that are no candidates of each query; None = all images are candidates.
    """

    name: str
    images: ImageFolder
    truth: Truth | None
    excluded: Positives | None = None


@dataclass(frozen=True)
class Dataset:
    """One database and at least one sequence of queries; `name` stands in results."""

    name: str
    database: ImageFolder
    sequences: tuple[QuerySequence, ...]

    @property
    def only(self) -> QuerySequence:
        """The only sequence; InputError if there are several."""
        if len(self.sequences) != 1:
            raise InputError(f"{self.name}: expected one query sequence, got {len(self.sequences)}; choose one of "
                             f"{', '.join(sequence.name for sequence in self.sequences)}")  # fmt: skip
        return self.sequences[0]

    @property
    def queries(self) -> ImageFolder:
        """Query images of the only sequence."""
        return self.only.images

    @property
    def truth(self) -> Truth | None:
        """Ground truth of the only sequence."""
        return self.only.truth


def image_folder(root: Path | str, *, orient: bool = True, bits: int | None = 16) -> ImageFolder:
    """All images below `root`, in subfolders and linked folders as well; hidden files and folders are skipped.

    Args:
        root: folder.
        orient, bits: see `mfvpr.datasets.images.read_image`.

    Raises:
        InputError: no such folder, a folder that cannot be listed, a broken link, a link to a parent folder, or no
            images.
    """
    root = Path(root)
    if not root.is_dir():
        got = "a file" if os.path.lexists(root) else "nothing"
        raise InputError(f"{root}: expected a folder of images, got {got}; check the path")
    names = [path.relative_to(root).as_posix() for path in _images_below(root)]
    if not names:
        raise InputError(f"{root}: expected images ({', '.join(sorted(IMAGE_SUFFIXES))}), found none; check the path")
    if bits is not None and not 8 <= bits <= 16:
        raise InputError(f"bits={bits}: expected from 8 to 16 bits in use, or none")
    return ImageFolder(root, tuple(sorted(names, key=_natural)), orient, bits)


def folder_dataset(
    database: Path | str,
    queries: Path | str,
    *,
    ground_truth: str,
    name: str = "folder",
    index_file: Path | str | None = None,
    widen_index: bool = False,
    database_labels: Path | str | None = None,
    query_labels: Path | str | None = None,
    orient: bool = True,
    bits: int | None = 16,
) -> Dataset:
    """Two folders of images as a data set.

    Args:
        database: folder of database images.
        queries: folder of query images.
        ground_truth: kind of ground truth, one of `ground_truth.KINDS`; "none" = rankings only.
        name: in results.
        index_file: for `index`, see `truth_files.truth_from_file`.
        widen_index: for `index`, whether database images within a tolerance in frames count as well.
        database_labels, query_labels: for `label`, see `truth_files.truth_from_labels`.
        orient, bits: see `mfvpr.datasets.images.read_image`.
    """
    images = image_folder(database, orient=orient, bits=bits)
    files = {"index_file": index_file, "database_labels": database_labels, "query_labels": query_labels}
    return Dataset(name, images, (_sequence(name, images, queries, ground_truth, files, widen_index),))


def sequences_dataset(
    database: Path | str,
    queries: Sequence[Path | str],
    *,
    ground_truth: str,
    name: str = "sequences",
    index_file: str | None = None,
    widen_index: bool = False,
    orient: bool = True,
    bits: int | None = 16,
) -> Dataset:
    """One folder of database images and several folders of queries, each a sequence with the name of its folder.

    Args:
        database: folder of database images.
        queries: folders of query images, with different names that are not in `MEANS`.
        ground_truth: kind of ground truth of every sequence, one of `ground_truth.KINDS` except `label`.
        name: in results.
        index_file: for `index`, the file's name in the folder of each sequence.
        widen_index, orient, bits: see `folder_dataset`.

    Raises:
        InputError: no sequence, two sequences of one name, or a sequence with the name of a mean.
    """
    folders = [Path(folder) for folder in queries]
    names = [(folder.resolve() if folder.name in ("", "..") else folder).name for folder in folders]
    if not names:
        raise InputError("queries: expected the folder of at least one sequence, got none")
    if len({*names}) < len(names):
        duplicate = max(names, key=names.count)
        raise InputError(f"queries: expected sequences of different names, got {duplicate} twice; rename a folder")
    for mean in {*names} & {*MEANS}:
        raise InputError(f"queries: expected no sequence called {mean}, the name of a mean in results; rename it")
    images, sequences = image_folder(database, orient=orient, bits=bits), []
    for folder_name, folder in zip(names, folders, strict=True):
        files = {"index_file": folder / index_file if index_file else None}
        sequences.append(_sequence(folder_name, images, folder, ground_truth, files, widen_index))
    return Dataset(name, images, tuple(sequences))


def _sequence(
    name: str,
    database: ImageFolder,
    queries: Path | str,
    ground_truth: str,
    files: Mapping[str, Path | str | None],
    widen_index: bool,
) -> QuerySequence:
    """The queries of a folder with their ground truth; `orient` and `bits` are those of the database."""
    images = image_folder(queries, orient=database.orient, bits=database.bits)
    _check_files(ground_truth, files)
    names = images.names, database.names
    truth: Truth | None = None
    if ground_truth == "order":
        truth = truth_by_order(len(images), len(database))
    elif ground_truth == "utm":
        truth = truth_from_names(*names)
    elif index_file := files["index_file"]:
        truth = truth_from_file(index_file, *names, widened=widen_index)
    elif (query_labels := files.get("query_labels")) and (database_labels := files.get("database_labels")):
        truth = truth_from_labels(query_labels, database_labels, *names)
    return QuerySequence(name, images, truth)


def _check_files(ground_truth: str, files: Mapping[str, Path | str | None]) -> None:
    if ground_truth not in KINDS:
        raise InputError(f"ground_truth={ground_truth}: expected one of {CHOICES}")
    for option, kind in FILES.items():
        path = files.get(option)
        if path is not None and kind != ground_truth:
            raise InputError(f"{path}: given as {option}, but ground_truth={ground_truth}; set it to {kind}")
        if path is None and kind == ground_truth:
            raise InputError(f"ground_truth={kind}: expected a file; give {option} as well")


def _images_below(root: Path) -> Iterator[Path]:
    waiting: list[tuple[Path, tuple[tuple[int, int], ...]]] = [(root, ())]  # folders with their parents' numbers
    while waiting:
        folder, parents = waiting.pop()
        try:
            status = folder.stat()
            entries = list(os.scandir(folder))
            folders = {entry.name for entry in entries if entry.is_dir()}
        except OSError as error:
            raise InputError(f"{folder}: cannot be listed ({error.strerror}); make it readable, or remove it") from None
        number = (status.st_dev, status.st_ino)
        if number in parents:
            raise InputError(f"{folder}: a link back to {folder.resolve()}, which it is in; remove it")
        for entry in entries:
            path = folder / entry.name
            if entry.name.startswith("."):
                continue
            if entry.name in folders:
                waiting.append((path, (*parents, number)))
            elif path.suffix.lower() in IMAGE_SUFFIXES:
                yield path
            elif entry.is_symlink() and not path.exists():
                raise InputError(f"{path}: a link to nothing, which may have been a folder; mend or remove it")


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key in which runs of digits, of any length, compare as numbers."""
    parts = [part.lstrip("0") if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
    return [(1, len(part), part) if place % 2 else (0, 0, part) for place, part in enumerate(parts)], name
