"""A data set: database images, query images, and where the queries really are."""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from mfvpr.data.ground_truth import Truth, truth_by_order, truth_from_file, truth_from_names
from mfvpr.data.images import SUFFIXES, ordered_map
from mfvpr.errors import InputError


@dataclass(frozen=True)
class ImageFolder:
    """Images below `root`, by relative POSIX path in natural order (image2 before image10)."""

    root: Path
    names: tuple[str, ...]

    @property
    def paths(self) -> list[Path]:
        """Full paths, in order."""
        return [self.root / name for name in self.names]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Dataset:
    """Database and queries with their ground truth (None = only rankings can be told)."""

    name: str
    database: ImageFolder
    queries: ImageFolder
    truth: Truth | None


def image_folder(root: Path) -> ImageFolder:
    """All images below `root`, subfolders included.

    Raises:
        InputError: no such folder, or no images in it.
    """
    if not root.is_dir():
        raise InputError(
            f"{root}: expected a folder of images, got {'a file' if root.exists() else 'nothing'}; check the path"
        )
    names = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    ]
    if not names:
        raise InputError(f"{root}: expected images ({', '.join(sorted(SUFFIXES))}), found none; check the path")
    return ImageFolder(root, tuple(sorted(names, key=_natural)))


def folder_dataset(
    database: Path, queries: Path, *, name: str = "folder", ground_truth: str = "order", index_file: Path | None = None
) -> Dataset:
    """Two folders of images as a data set.

    Args:
        database: folder of database images.
        queries: folder of query images.
        name: what results call it.
        ground_truth: `order` (query i shows database image i), `index` (`index_file`), `utm` (in the names), `none`.
        index_file: for `index`, see `ground_truth.truth_from_file`.
    """
    database_folder, query_folder = image_folder(database), image_folder(queries)
    return Dataset(name, database_folder, query_folder, _truth(database_folder, query_folder, ground_truth, index_file))


def fingerprint(folder: ImageFolder) -> str:
    """SHA-256 over names and contents of all images, in order; the first 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for name, content in zip(folder.names, ordered_map(_content_digest, folder.paths, workers=2), strict=True):
        digest.update(name.encode("utf-8", "surrogateescape") + b"\0" + content)
    return digest.hexdigest()[:16]


def _truth(database: ImageFolder, queries: ImageFolder, kind: str, index_file: Path | None) -> Truth | None:
    if index_file is not None and kind != "index":
        raise InputError(f"{index_file}: given as index file, but dataset.ground_truth={kind}; set it to index")
    if kind == "order":
        return truth_by_order(len(queries), len(database))
    if kind == "index":
        if index_file is None:
            raise InputError("ground truth by index: expected a file; set dataset.index_file=FILE (.csv, .npz, .json)")
        return truth_from_file(index_file, queries.names, database.names)
    return truth_from_names(queries.names, database.names) if kind == "utm" else None


def _content_digest(path: Path) -> bytes:
    try:
        if path.is_file():
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").digest()
    except OSError:
        pass  # whoever reads the image will tell
    return b"unreadable"


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key in which runs of digits compare as numbers."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts], name
