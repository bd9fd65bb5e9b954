"""Read the matches and keypoints of kapture's folders."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mfvpr.io.containers import reading, shorten
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader
from mfvpr.utils.errors import InputError

_MATCHES, _SEPARATOR, _SUFFIX = Path("reconstruction/matches"), ".overlapping/", ".matches"
_NUMBERS = {"float32": "<f4", "float64": "<f8", "float": "<f8"}  # types of keypoints


class KapturePairs(PairReader):
    """Reader of `reconstruction/matches/TYPE` with `reconstruction/keypoints/TYPE`.

    `path` is kapture's root, or a folder of matches if there are several types. Keypoints are taken as they are: their
    pixel centers are at whole numbers from extractors such as R2D2, and at half pixels if kapture has them from COLMAP.
    """

    by_number = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._matches, self._keypoints = self.folders(path)
        self._type, self._columns = _keypoint_layout(self._keypoints / "keypoints.txt")
        files = [file.relative_to(self._matches).as_posix() for file in sorted(self._matches.rglob(f"*{_SUFFIX}"))]
        self._files: dict[Pair, str] = {}
        for file in files:
            first, separator, second = file.removesuffix(_SUFFIX).partition(_SEPARATOR)
            if not separator:
                raise InputError(f"{self._matches / file}: expected a file IMAGE{_SEPARATOR}IMAGE{_SUFFIX}; remove it")
            self._files[first, second] = file
        if not files:
            raise InputError(f"{self._matches}: expected files named {_SUFFIX}, got none; unpack archives first")
        self.images = tuple(dict.fromkeys(name for pair in self._files for name in pair))

    @staticmethod
    def folders(path: Path) -> tuple[Path, Path]:
        """Folders of matches and of keypoints."""
        matches = _matches_folder(path)
        return matches, matches.parents[1] / "keypoints" / matches.name

    @staticmethod
    def fits(folder: Path) -> bool:
        """Whether a folder looks like kapture's."""
        return (folder / _MATCHES).is_dir() or folder.parent.match(_MATCHES.as_posix())

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._files

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        for pair in pairs:
            path = self._matches / self._files[pair]
            values = _read_matrix(path, "<f8", 3)
            numbers = values[:, :2].astype(np.int64, casting="unsafe") if np.isfinite(values).all() else None
            if numbers is None or (numbers != values[:, :2]).any():
                raise InputError(f"{path}: expected rows of two whole numbers and a score, got others; match again")
            yield FileMatches(numbers[:, 0], numbers[:, 1], values[:, 2])

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"]:
        return _read_matrix(self._keypoints / f"{image}.kpt", self._type, self._columns)[:, :2]


def _matches_folder(path: Path) -> Path:
    """The folder of the only type of matches."""
    if path.parent.match(_MATCHES.as_posix()):
        return path
    folders = sorted(folder for folder in (path / _MATCHES).iterdir() if folder.is_dir())
    if len(folders) != 1:
        names = ", ".join(folder.name for folder in folders) or "none"
        raise InputError(f"{path / _MATCHES}: expected one type of matches, got {shorten(names)}; give its folder")
    return folders[0]


def _keypoint_layout(path: Path) -> tuple[str, int]:
    """Type and number of columns, from the line `name, dtype, dsize` of a `keypoints.txt`."""
    with reading(path, "kapture's keypoints.txt"):
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [[word.strip() for word in line.split(",")] for line in lines if line and not line.startswith("#")]
    match lines:
        case [[_, kind, columns]] if (
            kind.removeprefix("numpy.") in _NUMBERS and columns.isdecimal() and int(columns) > 1
        ):
            return _NUMBERS[kind.removeprefix("numpy.")], int(columns)
    got = shorten("; ".join(", ".join(line) for line in lines))
    raise InputError(f"{path}: expected a line name, dtype, dsize with float32 or float64 and at least 2, got {got!r}")


def _read_matrix(path: Path, kind: str, columns: int) -> Float[np.ndarray, "rows columns"]:
    with reading(path, "a file of kapture"):
        content = path.read_bytes()
    if len(content) % (columns * np.dtype(kind).itemsize):
        raise InputError(
            f"{path}: expected rows of {columns} numbers of {np.dtype(kind).name}, got {len(content)} bytes"
        )
    return np.frombuffer(content, kind).reshape(-1, columns)
