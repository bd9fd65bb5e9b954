"""Data sets: database images, query images, and ground truth."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath

from mfvpr.datasets.ground_truth import (
    CHOICES,
    AllowedTruth,
    FrameTruth,
    Truth,
    truth_from_file,
    truth_from_labels,
    truth_from_names,
)
from mfvpr.datasets.image_reading import Ignored, Pixels, fill_ignored, read_image
from mfvpr.datasets.positives import Positives
from mfvpr.io.containers import require_all
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import IMAGE_SUFFIXES
from mfvpr.utils.fingerprints import fingerprint, recipe_of

IdenticalRows = tuple[tuple[int, ...], ...]  # database rows of files with the content of each query
MEANS = ("mean", "pooled")  # names in results of the means over sequences, and over all of their queries


@dataclass(frozen=True)
class IndexFile:
    """Ground truth of a file of pairs or positions, see `mfvpr.datasets.ground_truth.truth_from_file`.

    Example:
        data = mfvpr.datasets.folder("day/", "night/", ground_truth=mfvpr.datasets.IndexFile("pairs.csv"))
    """

    path: Path | str  # for several sequences, in the folder of each
    is_widened: bool = False  # whether database images within a tolerance in frames are correct as well


@dataclass(frozen=True)
class LabelFiles:
    """Ground truth of two files of labels, see `mfvpr.datasets.ground_truth.truth_from_labels`.

    Example:
        labels = mfvpr.datasets.LabelFiles(queries="night.csv", database="day.csv")
    """

    queries: Path | str
    database: Path | str


GroundTruth = IndexFile | LabelFiles | Truth


@dataclass(frozen=True, repr=False)
class ImageFolder:
    """Images below `root`.

    Example:
        mfvpr.datasets.image_folder("day/").read(0)  # [H, W, 3] uint8 RGB
    """

    root: Path
    names: tuple[str, ...]  # relative POSIX paths in natural order (image2 before image10)
    orient: bool = True  # see `mfvpr.datasets.image_reading.read_image`
    bits: int | None = 16
    masks: Path | None = None  # see `image_folder`
    mask_files: "ImageFolder | None" = field(init=False, compare=False)  # the mask of each image

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", Path(self.root))
        object.__setattr__(self, "mask_files", None if self.masks is None else _mask_files(self, Path(self.masks)))

    def __repr__(self) -> str:
        return f"ImageFolder({self.root}: {len(self)} images)"

    @property
    def paths(self) -> list[Path]:
        """Full paths of the images, in order."""
        return [self.root / name for name in self.names]

    def __len__(self) -> int:
        return len(self.names)

    def read(self, row: int) -> Pixels:
        """Read one image, filled where its mask ignores pixels; errors are those of `read_image`, `fill_ignored`."""
        return self.read_with_ignored(row)[0]

    def read_with_ignored(self, row: int) -> tuple[Pixels, Ignored | None]:
        """Read one image as `read` does, and which pixels its mask ignores; None without masks."""
        image, masks = read_image(self.root / self.names[row], orient=self.orient, bits=self.bits), self.mask_files
        if masks is None:
            return image, None
        return fill_ignored(image, masks.root / masks.names[row], orient=self.orient)


@dataclass(frozen=True, repr=False)
class QuerySequence:
    """Query images of one drive or walk, with their ground truth; `name` stands in results.

    Example:
        sequence = mfvpr.datasets.QuerySequence("night", mfvpr.datasets.image_folder("night/"), truth=None)
    """

    name: str
    images: ImageFolder
    truth: Truth | None  # which database images are correct; None = no ground truth, rankings only
    excluded: Positives | None = None  # database images that are no candidates of each query; None = none

    def __repr__(self) -> str:
        truth = type(self.truth).__name__ if self.truth else "no ground truth"
        return f"QuerySequence({self.name}: {len(self.images)} queries, {truth})"

    def without_neighbors(self, num_database: int, query_rows: IdenticalRows, neighbors: int) -> "QuerySequence":
        """Exclude each query and its neighbors within `neighbors` frames from its candidates; 0 = the query alone.

        Excluded images are not correct either. `query_rows` are the rows of each query in the database, a sequence of
        `num_database` images; an `InputError` if no query is among them.
        """
        if not any(query_rows):
            got = f"none in {self.images.root}; leave it out for two different sequences"
            raise InputError(f"exclude_neighbors={neighbors}: expected queries among the database images, got {got}")
        excluded = FrameTruth(query_rows, num_database).positives(neighbors)
        truth = None if self.truth is None else AllowedTruth(self.truth, excluded)
        return replace(self, truth=truth, excluded=excluded if self.excluded is None else self.excluded | excluded)


@dataclass(frozen=True, repr=False)
class Dataset:
    """One database, and `sequences` of queries, at least one; `name` stands in results.

    Example:
        data = mfvpr.datasets.folder("day/", ["night/", "snow/"], ground_truth="order")
    """

    name: str
    database: ImageFolder
    sequences: tuple[QuerySequence, ...]

    def __repr__(self) -> str:
        sizes = ", ".join(f"{sequence.name} ({len(sequence.images)} queries)" for sequence in self.sequences)
        return f"Dataset({self.name}: {len(self.database)} database images; {sizes})"

    @property
    def only(self) -> QuerySequence:
        """The only sequence; InputError if there are several."""
        if len(self.sequences) != 1:
            names = ", ".join(sequence.name for sequence in self.sequences)
            raise InputError(f"{self.name}: expected one sequence, got {len(self.sequences)}; choose one of {names}")
        return self.sequences[0]

    @property
    def queries(self) -> ImageFolder:
        """Query images of the only sequence."""
        return self.only.images

    @property
    def truth(self) -> Truth | None:
        """Ground truth of the only sequence."""
        return self.only.truth

    def positives_fingerprint(self, thresholds: Sequence[float]) -> str | None:
        """Fingerprint of the positives of all sequences, independent of their file; None without ground truth."""
        content = []
        for sequence in self.sequences:
            if sequence.truth is not None:
                positives = [sequence.truth.positives(threshold) for threshold in thresholds]
                content.append([sequence.name, *({"rows": each.rows, "offsets": each.offsets} for each in positives)])
        return fingerprint(recipe_of(content)) if content else None


def image_folder(
    root: Path | str, *, orient: bool = True, bits: int | None = 16, masks: Path | str | None = None
) -> ImageFolder:
    """All images below `root`, in subfolders and linked folders as well; hidden files and folders are skipped.

        mfvpr.datasets.image_folder("day/").read(0)  # [H, W, 3] uint8 RGB; for orient and bits see `read_image`

    `masks` are images that are black where pixels are ignored: one file for all images, or a folder. There, the mask of
    `a.jpg` is `a.jpg`, `a.png` (any suffix) or `a.jpg.png`, in a subfolder with the name of `root` if there is one.

    An `InputError` for a folder that is missing, empty or unreadable, a broken link, a link to a parent folder, or an
    image without a mask.
    """
    root, names = Path(root), []
    if not root.is_dir():
        got = "a file" if root.exists() else "nothing"
        raise InputError(f"{root}: expected a folder of images, got {got}; check the path")
    if bits is not None and not 8 <= bits <= 16:
        raise InputError(f"bits={bits}: expected from 8 to 16 bits in use, or none")

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be listed ({error.strerror}); make it readable, or remove it")

    for folder, folders, files in os.walk(root, onerror=refuse, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(folder, name) for name in folders):
            if path.is_symlink() and path.parent.resolve().is_relative_to(path.resolve()):
                raise InputError(f"{path}: expected files and folders, got a link back to {path.resolve()}; remove it")
        for path in (Path(folder, name) for name in files if not name.startswith(".")):
            if path.suffix.lower() in IMAGE_SUFFIXES:
                names.append(path.relative_to(root).as_posix())
            elif path.is_symlink() and not path.exists():
                raise InputError(f"{path}: expected an image or a folder, got a link to nothing; mend or remove it")
    if not names:
        raise InputError(f"{root}: expected images ({', '.join(sorted(IMAGE_SUFFIXES))}), got none; check the path")

    def natural(name: str) -> tuple[list[tuple[int, str]], str]:  # runs of digits compare as numbers of any length
        parts = [part.lstrip("0") if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
        return [(place % 2 and len(part), part) for place, part in enumerate(parts)], name

    return ImageFolder(root, tuple(sorted(names, key=natural)), orient, bits, None if masks is None else Path(masks))


def _mask_files(images: ImageFolder, masks: Path) -> ImageFolder:
    if masks.is_file():
        return ImageFolder(masks.parent, (masks.name,) * len(images))
    subfolder = masks / images.root.resolve().name
    files = image_folder(subfolder if subfolder.is_dir() else masks)
    stem = lambda name: str(PurePosixPath(name).with_suffix(""))  # noqa: E731
    mask_of = {stem(name): name for name in files.names} | {name: name for name in files.names}
    names = [mask_of.get(name, mask_of.get(stem(name))) for name in images.names]
    return replace(files, names=tuple(require_all(files.root, images.names, names, "masks (white ignores nothing)")))


def folder(
    database: Path | str,
    queries: Path | str | Sequence[Path | str],
    *,
    ground_truth: GroundTruth | str | None,
    name: str = "folder",
    orient: bool = True,
    bits: int | None = 16,
    masks: Path | str | None = None,
    among: Path | str | None = None,
) -> Dataset:
    """Folders of images as a data set: one of database images, and one or several of queries.

        data = mfvpr.datasets.folder("day/", ["night/", "snow/"], ground_truth="order")

    Args:
        database: folder of database images.
        queries: folder of query images; or several, each a sequence with the name of its folder. The names differ, and
            none is in `MEANS`.
        ground_truth: of every sequence. "order" = query i shows database image i; "utm" = positions in the names;
            "none" or None = rankings only; or files; or a ground truth of your own.
        name: in results.
        orient, bits: see `mfvpr.datasets.image_reading.read_image`.
        masks: of pixels to ignore, see `image_folder`.
        among: file of pairs as of `IndexFile`, of each query and the only database images that may be its candidates.
    """
    images = image_folder(database, orient=orient, bits=bits, masks=masks)
    sequence = partial(_sequence, images, ground_truth, among)
    if isinstance(queries, Path | str):
        return Dataset(name, images, (sequence(name, queries, Path()),))
    folders = [Path(path) for path in queries]
    names = [(path.resolve() if path.name in ("", "..") else path).name for path in folders]
    if not names or len({*names, *MEANS}) < len(names) + len(MEANS):
        got = ", ".join(names) or "none"
        raise InputError(f"queries: expected folders of different names, none called {' or '.join(MEANS)}, got {got}")
    return Dataset(name, images, tuple(map(sequence, names, folders, folders)))


def _sequence(
    database: ImageFolder,
    ground_truth: GroundTruth | str | None,
    among: Path | str | None,
    name: str,
    queries: Path | str,
    root: Path,
) -> QuerySequence:
    images = image_folder(queries, orient=database.orient, bits=database.bits, masks=database.masks)
    names = images.names, database.names
    match ground_truth:
        case None | "none":
            truth = None
        case Truth():
            truth = ground_truth
        case "order" if len(images) == len(database):
            truth = FrameTruth(tuple((row,) for row in range(len(images))), len(database))
        case "order":
            got = f"{len(images)} and {len(database)}; name the pairs in an index file"
            raise InputError(f"ground_truth=order: expected as many queries as database images, got {got}")
        case "utm":
            truth = truth_from_names(*names)
        case IndexFile(path, is_widened):
            truth = truth_from_file(root / path, *names, widened=is_widened)
        case LabelFiles(query_file, database_file):
            truth = truth_from_labels(root / query_file, root / database_file, *names)
        case _:
            files = "files are given as mfvpr.datasets.IndexFile(FILE) or LabelFiles(QUERIES, DATABASE)"
            raise InputError(f"ground_truth={ground_truth}: expected one of {CHOICES}; {files}")
    if among is None:
        return QuerySequence(name, images, truth)
    allowed = truth_from_file(root / among, *names)
    if not isinstance(allowed, FrameTruth):
        raise InputError(f"{root / among}: expected pairs of images, got positions; list the candidates of each query")
    return QuerySequence(name, images, truth, Positives(~allowed.positives(0).dense()))
