"""Files with matches of image pairs: hloc's HDF5, COLMAP's databases, kapture's folders."""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, NamedTuple
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Num

from mfvpr.io.containers import H5File, reading, shorten
from mfvpr.utils.errors import InputError

Size = tuple[float, float]  # (width, height), px
Pair = tuple[str, str]  # names of two images in a file


class FileMatches(NamedTuple):
    """Matches of one pair as a file has them.

    first, second: `[M]` numbers of keypoints, or `[M, 2]` (x, y), px.
    confidence: None = the file has none.
    sizes: of the images that the points are in; None = the file does not tell.
    """

    first: Num[np.ndarray, "matches ..."]
    second: Num[np.ndarray, "matches ..."]
    confidence: Num[np.ndarray, " matches"] | None = None
    sizes: tuple[Size, Size] | None = None


class PairReader:
    """Base class of readers of matches; a pair of names has an order.

    Attributes:
        path: file or folder, for messages.
        places: where the matches of each pair are; they may be none.
        images: their names in the file.
        by_number: whether matches are numbers of keypoints.
        sided: whether the first name of a pair is always the query's, so that a name may also be a database image's.
        in_image_files: whether points without sizes are in the px of the image files.
    """

    by_number: bool = True
    sided: bool = False
    in_image_files: ClassVar[bool] = True

    def __init__(self, path: Path, places: Mapping[Pair, Any]) -> None:
        self.path, self.places = path, places
        self.images = tuple(dict.fromkeys(chain(*places)))

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        """Matches of pairs that the file contains."""
        raise NotImplementedError

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"] | None:
        """Keypoints (x, y) of an image, px, pixel centers at whole numbers (but see kapture); None = no keypoints."""
        return None

    def image_size(self, image: str) -> Size | None:
        """Size of an image; None = the file does not tell."""
        return None

    def spelling(self, name: str) -> str:
        """The name of an image in the spelling of the file."""
        return name


class HlocPairs(PairReader):
    """Reader of hloc's HDF5: a group `IMAGE/IMAGE` for each pair, with `-` for each `/` of the names.

    A matcher of features writes numbers (`matches0`), a dense matcher points in the px of the image files.
    """

    def __init__(self, path: Path) -> None:
        self._file = H5File(path)
        groups = [group for group in self._file.entries if group.count("/") == 1]
        [arrays] = self._file.shapes(groups[:1], (), ("matches0", "keypoints0")) if groups else [{}]
        if not arrays:
            raise InputError(
                f"{path}: expected groups IMAGE/IMAGE of matches, as hloc writes them since 2021, got others; give "
                "matches*.h5, not feats*.h5, or match again"
            )
        self.by_number = "keypoints0" not in arrays
        pairs = [[self.spelling(name) for name in group.split("/")] for group in groups]
        super().__init__(path, {(query, image): group for (query, image), group in zip(pairs, groups, strict=True)})
        if len(self.places) < len(groups):
            raise InputError(f"{path}: expected different names of images, got two that differ by - and / alone")

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        groups = [self.places[pair] for pair in pairs]
        parts = ("matches0", "matching_scores0") if self.by_number else ("keypoints0", "keypoints1", "scores")
        for group, arrays in zip(groups, self._file.arrays(groups, parts), strict=True):
            where, score = f"{self.path}: {shorten(group)}", arrays.get(parts[-1])
            if missing := [part for part in parts[:-1] if part not in arrays]:
                raise InputError(f"{where}: expected {' and '.join(parts[:-1])}, got no {missing[0]}")
            if not self.by_number:
                yield FileMatches(arrays["keypoints0"], arrays["keypoints1"], score)
                continue
            partners = arrays["matches0"]  # the number of each keypoint's partner, -1 = none
            if partners.ndim != 1 or partners.dtype.kind not in "iu" or (partners < -1).any():
                raise InputError(
                    f"{where}: expected matches0 [N] of integers from -1, got others; hloc writes int16, so "
                    "match at most 32768 keypoints"
                )
            if score is not None and score.shape != partners.shape:
                raise InputError(f"{where}: expected matching_scores0 {[*partners.shape]}, got {[*score.shape]}")
            first = np.flatnonzero(partners >= 0)
            yield FileMatches(first, partners[first], None if score is None else score[first])

    def spelling(self, name: str) -> str:
        return name.replace("-", "/")


class ColmapPairs(PairReader):
    """Reader of COLMAP's SQLite table `matches`, or of `two_view_geometries` if `verified`; it changes nothing."""

    _MOST_IMAGES = 2**31 - 1  # the number of a pair is this times the number of the first image plus the other

    def __init__(self, path: Path, verified: bool = False) -> None:
        self.path = path
        self._table = "two_view_geometries" if verified else "matches"
        with self._open() as database:
            images = "SELECT image_id, name, width, height FROM images JOIN cameras USING (camera_id)"
            self._images = {name: (number, (width, height)) for number, name, width, height in database.execute(images)}
            names = {number: name for name, (number, _) in self._images.items()}
            places = {}
            for (number,) in database.execute(f"SELECT pair_id FROM {self._table}"):
                first, second = divmod(number, self._MOST_IMAGES)
                if first in names and second in names:  # images may have been removed
                    places[names[first], names[second]] = number
        super().__init__(path, places)

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        for pair in pairs:
            numbers = self._matrix(self._table, "pair_id", self.places[pair], "<u4").astype(np.int64)
            yield FileMatches(numbers[:, 0], numbers[:, 1])

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"]:
        points = self._matrix("keypoints", "image_id", self._images[image][0], "<f4")[:, :2]
        return points - np.float32(0.5)  # the center of COLMAP's first pixel, px

    def image_size(self, image: str) -> Size:
        return self._images[image][1]

    def _matrix(self, table: str, column: str, number: int, dtype: str) -> Num[np.ndarray, "rows columns"]:
        """The matrix of a row `(rows, cols, data)` of a table, of 2 or more columns; without a row, it is empty."""
        query = f"SELECT rows, cols, data FROM {table} WHERE {column} = ?"
        with self._open() as database:
            rows, columns, content = database.execute(query, (number,)).fetchone() or (0, 2, b"")
            if rows and columns < 2:
                raise InputError(f"expected 2 or more columns in {table}, got {columns}")
            return np.frombuffer(content, dtype).reshape(rows, columns) if rows else np.zeros((0, 2), dtype)

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """The database, opened read-only; an InputError for changes beside it, and for SQLite's errors."""
        target = self.path.resolve()  # beside which SQLite writes its journals
        for journal in (Path(f"{target}-wal"), Path(f"{target}-journal")):
            if journal.is_file() and journal.stat().st_size:
                raise InputError(f"{self.path}: expected a closed database, got changes in {journal}; close COLMAP")
        address = f"file:{quote(str(target))}?mode=ro&immutable=1"  # writes no file beside it either
        with (
            reading(self.path, "a COLMAP database", "is it whole, and COLMAP's?"),
            closing(sqlite3.connect(address, uri=True)) as database,
        ):
            database.execute("PRAGMA trusted_schema = OFF")
            yield database


class KapturePairs(PairReader):
    """Reader of kapture's `reconstruction/matches/TYPE` with `reconstruction/keypoints/TYPE`.

    `path` is kapture's root, or a folder of matches if there are several types. Keypoints are taken as they are: their
    pixel centers are at whole numbers from extractors such as R2D2, and at half pixels if kapture has them from COLMAP.
    """

    _MATCHES = Path("reconstruction/matches")
    _NUMBERS: ClassVar = {"float32": "<f4", "float64": "<f8", "float": "<f8"}  # types of keypoints

    def __init__(self, path: Path) -> None:
        self._matches, self._keypoints = self.folders(path)
        layout = self._keypoints / "keypoints.txt"  # the line `name, dtype, dsize`
        with reading(layout, mend="expected a line name, dtype, dsize with float32 or float64 and at least 2"):
            lines = layout.read_text(encoding="utf-8").splitlines()
            [(_, kind, columns)] = [
                line.replace(" ", "").split(",") for line in lines if line.strip() and line[0] != "#"
            ]
            self._type, self._columns = self._NUMBERS[kind.removeprefix("numpy.")], int(columns)
        places: dict[Pair, Path] = {}
        for file in sorted(self._matches.rglob("*.matches")):
            name = file.relative_to(self._matches).as_posix().removesuffix(".matches")
            first, _, second = name.partition(".overlapping/")
            places[first, second] = file
        if not places:
            expected = "files IMAGE.overlapping/IMAGE.matches"
            raise InputError(f"{self._matches}: expected {expected}, got none; unpack archives first")
        super().__init__(path, places)

    @classmethod
    def folders(cls, path: Path) -> tuple[Path, Path]:
        """Folders of matches and of keypoints, of the only type in kapture's root."""
        if not path.parent.match(cls._MATCHES.as_posix()):
            folders = [folder for folder in (path / cls._MATCHES).iterdir() if folder.is_dir()]
            if len(folders) != 1:
                names = ", ".join(sorted(folder.name for folder in folders)) or "none"
                raise InputError(f"{path / cls._MATCHES}: expected one type of matches, got {names}; give its folder")
            [path] = folders
        return path, path.parents[1] / "keypoints" / path.name

    @classmethod
    def fits(cls, folder: Path) -> bool:
        """Whether a folder looks like kapture's."""
        return (folder / cls._MATCHES).is_dir() or folder.parent.match(cls._MATCHES.as_posix())

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        for path in (self.places[pair] for pair in pairs):
            values = self._read_matrix(path, "<f8", 3)
            if (values[:, :2] % 1 != 0).any():  # NaN neither
                raise InputError(f"{path}: expected rows of two whole numbers and a score, got others; match again")
            yield FileMatches(values[:, 0].astype(np.int64), values[:, 1].astype(np.int64), values[:, 2])

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"]:
        return self._read_matrix(self._keypoints / f"{image}.kpt", self._type, self._columns)[:, :2]

    def _read_matrix(self, path: Path, kind: str, columns: int) -> Float[np.ndarray, "rows columns"]:
        with reading(path, "a file of kapture"):
            return np.frombuffer(path.read_bytes(), kind).reshape(-1, columns)
