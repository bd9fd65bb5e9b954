"""Files with matches of image pairs: hloc's HDF5, COLMAP's databases, kapture's folders, folders of results.

Results are a file for each pair (`.npz`, vismatch's `.torch`), or a `.torch` file of To-Match beside each text file of
VPR-methods-evaluation's predictions.
"""

import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Num

from mfvpr.io.containers import H5File, choose_reader, read_npz, reading, shorten
from mfvpr.io.object_files import ArrayUnpickler, open_torch_archive
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable

Size = tuple[float, float]  # (width, height), px
Pair = tuple[str, str]  # names of two images in a file


class FileMatches(NamedTuple):
    """Matches of one pair as a file has them: numbers of keypoints `[M]`, or points `[M, 2]` (x, y), px."""

    first: Num[np.ndarray, "matches ..."]
    second: Num[np.ndarray, "matches ..."]
    confidence: Num[np.ndarray, " matches"] | None = None
    sizes: tuple[Size, Size] | None = None  # of the images that the points are in; None = the file does not tell


@dataclass(frozen=True)
class PairFiles:
    """Matches of image pairs in a file or folder `path`; a pair of names has an order."""

    path: Path
    places: Mapping[Pair, Any]  # of the matches of each pair; they may be none
    read: Callable[[Sequence[Any]], Iterator[FileMatches]]  # matches at some of the places, in their order
    by_number: bool = True  # whether matches are numbers of keypoints
    sided: bool = False  # whether the first name of a pair is always the query's, and may be a database image's as well
    in_image_files: bool = True  # whether points without sizes are in the px of the image files
    # Keypoints (x, y) of an image, px, pixel centers at whole numbers (but see kapture); None = unknown.
    keypoints: Callable[[str], Float[np.ndarray, "keypoints 2"]] | None = None
    image_size: Callable[[str], Size] | None = None  # of an image
    spelling: Callable[[str], str] = str  # of the name of an image in the file

    @property
    def images(self) -> list[str]:
        """Names of the images in the file."""
        return list(dict.fromkeys(chain(*self.places)))


def open_pairs(path: Path, names: tuple[Sequence[str], Sequence[str]], verified: bool = False) -> PairFiles:
    """Matches of the queries and database images `names`; only those that fit a geometric model if `verified`."""
    if any(file.with_suffix(".txt").exists() for file in path.glob("*.torch")):  # To-Match's, beside predictions
        return open_predictions(path, verified)
    if path.is_dir() and not is_kapture(path):
        return open_results(path, names, verified)
    kinds = {".h5": open_hloc, ".hdf5": open_hloc, ".db": open_colmap}
    kind = open_kapture if path.is_dir() else choose_reader(path, kinds)
    if kind is open_colmap:
        return open_colmap(path, verified)
    if verified:
        expected = "COLMAP's .db, or results of vismatch or To-Match, with verified=True"
        raise InputError(f"{path}: expected {expected}, got another format; set verified=False")
    return kind(path)


def content_paths(path: Path) -> list[Path]:
    """Files and folders that decide the matches in `path`, without links."""
    return [each.resolve() for each in (kapture_folders(path) if path.is_dir() and is_kapture(path) else [path])]


def open_hloc(path: Path) -> PairFiles:
    """hloc's HDF5: a group `IMAGE/IMAGE` for each pair, with `-` for each `/` of the names.

    A matcher of features writes numbers (`matches0`), a dense matcher points in the px of the image files.
    """
    file = H5File(path)
    groups = [group for group in file.entries if group.count("/") == 1]
    [arrays] = file.read(groups[:1], ("matches0", "keypoints0"), shapes=True) if groups else [{}]
    if not arrays:
        expected = "groups IMAGE/IMAGE of matches, as hloc writes them since 2021"
        raise InputError(f"{path}: expected {expected}, got others; give matches*.h5, not feats*.h5, or match again")
    by_number = "keypoints0" not in arrays
    parts = ("matches0", "matching_scores0") if by_number else ("keypoints0", "keypoints1", "scores")

    def spelling(name: str) -> str:
        return name.replace("-", "/")

    def read(places: Sequence[str]) -> Iterator[FileMatches]:
        for group, arrays in zip(places, file.read(places, parts), strict=True):
            where, score = f"{path}: {shorten(group)}", arrays.get(parts[-1])
            if not {*parts[:-1]} <= arrays.keys():
                raise InputError(f"{where}: expected {' and '.join(parts[:-1])}, got {[*arrays]}; match again")
            if not by_number:
                yield FileMatches(arrays["keypoints0"], arrays["keypoints1"], score)
                continue
            partners = arrays["matches0"]  # the number of each keypoint's partner, -1 = none
            is_number = partners.ndim == 1 and partners.dtype.kind in "iu" and not (partners < -1).any()
            if not is_number or (score is not None and score.shape != partners.shape):
                mend = "hloc writes int16, so match at most 32768 keypoints"
                got = f"{partners.dtype}{[*partners.shape]}; {mend}"
                raise InputError(f"{where}: expected integers matches0 [N] from -1, and as many scores, got {got}")
            first = np.flatnonzero(partners >= 0)
            yield FileMatches(first, partners[first], None if score is None else score[first])

    places: dict[Pair, str] = {}
    for group in groups:
        first, second = map(spelling, group.split("/"))
        places[first, second] = group
    if len(places) < len(groups):
        raise InputError(f"{path}: expected different names, got two that differ by - and / alone; rename an image")
    return PairFiles(path, places, read, by_number, spelling=spelling)


_MOST_IMAGES = 2**31 - 1  # the number of a pair is this times the number of the first image plus the other


def open_colmap(path: Path, verified: bool = False) -> PairFiles:
    """COLMAP's SQLite table `matches`, or `two_view_geometries` if `verified`; nothing is changed."""
    table = "two_view_geometries" if verified else "matches"
    with _open_database(path) as database:
        rows = database.execute("SELECT name, image_id, width, height FROM images JOIN cameras USING (camera_id)")
        images = {name: (number, (width, height)) for name, number, width, height in rows}
        names = {number: name for name, (number, _) in images.items()}
        numbers = [number for (number,) in database.execute(f"SELECT pair_id FROM {table}")]
    pairs = {number: divmod(number, _MOST_IMAGES) for number in numbers}
    places = {  # images may have been removed
        (names[first], names[second]): number
        for number, (first, second) in pairs.items()
        if first in names and second in names
    }

    def matrix(table: str, column: str, number: int, dtype: str) -> Num[np.ndarray, "rows columns"]:
        """The matrix of a row of a table, of 2 or more columns; without a row, it is empty."""
        query = f"SELECT rows, cols, data FROM {table} WHERE {column} = ?"
        with _open_database(path) as database:
            rows, columns, content = database.execute(query, (number,)).fetchone() or (0, 2, b"")
            if rows and columns < 2:
                raise InputError(f"expected 2 or more columns in {table}, got {columns}; match again")
            return np.frombuffer(content, dtype).reshape(rows, columns) if rows else np.zeros((0, 2), dtype)

    def read(places: Sequence[int]) -> Iterator[FileMatches]:
        for place in places:
            numbers = matrix(table, "pair_id", place, "<u4").astype(np.int64)
            yield FileMatches(numbers[:, 0], numbers[:, 1])

    def keypoints(image: str) -> Float[np.ndarray, "keypoints 2"]:
        points = matrix("keypoints", "image_id", images[image][0], "<f4")[:, :2]
        return points - np.float32(0.5)  # the center of COLMAP's first pixel, px

    return PairFiles(path, places, read, keypoints=keypoints, image_size=lambda image: images[image][1])


@contextmanager
def _open_database(path: Path) -> Iterator[sqlite3.Connection]:
    """The database, opened read-only; an InputError for changes beside it, and for SQLite's errors."""
    target = path.resolve()  # beside which SQLite writes its journals
    for journal in (Path(f"{target}-wal"), Path(f"{target}-journal")):
        if journal.is_file() and journal.stat().st_size:
            raise InputError(f"{path}: expected a closed database, got changes in {journal}; close COLMAP")
    address = f"file:{quote(str(target))}?mode=ro&immutable=1"  # writes no file beside it either
    with (
        reading(path, "a COLMAP database", "is it whole, and COLMAP's?"),
        closing(sqlite3.connect(address, uri=True)) as database,
    ):
        database.execute("PRAGMA trusted_schema = OFF")
        yield database


_KAPTURE = Path("reconstruction/matches")
_NUMBERS = {"float32": "<f4", "float64": "<f8", "float": "<f8"}  # types of keypoints


def is_kapture(folder: Path) -> bool:
    """Whether a folder looks like kapture's."""
    return (folder / _KAPTURE).is_dir() or folder.parent.match(_KAPTURE.as_posix())


def kapture_folders(path: Path) -> tuple[Path, Path]:
    """Folders of matches and of keypoints, of the only type in kapture's root."""
    if not path.parent.match(_KAPTURE.as_posix()):
        folders = [folder for folder in (path / _KAPTURE).iterdir() if folder.is_dir()]
        if len(folders) != 1:
            names = ", ".join(sorted(folder.name for folder in folders)) or "none"
            raise InputError(f"{path / _KAPTURE}: expected one type of matches, got {names}; give its folder")
        [path] = folders
    return path, path.parents[1] / "keypoints" / path.name


def open_kapture(path: Path) -> PairFiles:
    """kapture's `reconstruction/matches/TYPE` with `reconstruction/keypoints/TYPE`.

    `path` is kapture's root, or a folder of matches if there are several types. Keypoints are taken as they are: pixel
    centers are at whole numbers, or at half pixels from COLMAP.
    """
    matches, features = kapture_folders(path)
    layout = features / "keypoints.txt"  # the line `name, dtype, dsize`
    with reading(layout, mend="expected a line name, dtype, dsize with float32 or float64 and at least 2"):
        lines = layout.read_text(encoding="utf-8").splitlines()
        [(_, kind, columns)] = [line.replace(" ", "").split(",") for line in lines if line.strip() and line[0] != "#"]
        dtype, width = _NUMBERS[kind.removeprefix("numpy.")], int(columns)
    places: dict[Pair, Path] = {}
    for file in sorted(matches.rglob("*.matches")):
        first, _, second = file.relative_to(matches).as_posix().removesuffix(".matches").partition(".overlapping/")
        places[first, second] = file
    if not places:
        raise InputError(f"{matches}: expected files IMAGE.overlapping/IMAGE.matches, got none; unpack archives first")

    def matrix(path: Path, dtype: str, width: int) -> Float[np.ndarray, "rows columns"]:
        with reading(path, "a file of kapture"):
            return np.frombuffer(path.read_bytes(), dtype).reshape(-1, width)

    def read(places: Sequence[Path]) -> Iterator[FileMatches]:
        for file in places:
            values = matrix(file, "<f8", 3)
            if (values[:, :2] % 1 != 0).any():  # NaN neither
                raise InputError(f"{file}: expected rows of two whole numbers and a score, got others; match again")
            yield FileMatches(values[:, 0].astype(np.int64), values[:, 1].astype(np.int64), values[:, 2])

    return PairFiles(path, places, read, keypoints=lambda image: matrix(features / f"{image}.kpt", dtype, width)[:, :2])


QUERY, PREDICTIONS, POSITIVES = "Query path:", "Predictions paths:", "Positives paths:"  # headings
_NAMES = ("img0_path", "img1_path")  # vismatch's
_LAYOUTS = (("points0", "points1", "confidence"), ("matched_kpts0", "matched_kpts1", "matched_confidences"))
_INLIERS = ("inlier_kpts0", "inlier_kpts1", "")
_NUMBERED = ("keypoints0", "keypoints1", "matches", "match_confidence")  # SuperGlue's
_SIZES = ("image_size0", "image_size1", "im_size")  # the last: side of vismatch's square images
_PARTS = {*_NAMES, *chain(*_LAYOUTS), *_INLIERS, *_NUMBERED, *_SIZES}


def open_results(path: Path, names: tuple[Sequence[str], Sequence[str]], verified: bool = False) -> PairFiles:
    """A folder of files of a pair, which have the `names` of the images in them or in their own names.

    Names of files, `QUERY_DATABASE.npz`, have no folders, so that both sides may have the same names: `sided`.
    """
    stems = [{PurePosixPath(name).stem for name in side} for side in names]
    places: dict[Pair, Path] = {}
    has_names = set[bool]()  # whether files name their images
    for file in sorted(file for file in path.iterdir() if file.suffix in (".npz", ".torch")):
        parts = read_npz(file, _NAMES) if file.suffix == ".npz" else _read_torch(file)
        pairs = [(str(parts[_NAMES[0]]), str(parts[_NAMES[1]]))] if {*_NAMES} <= parts.keys() else []
        has_names.add(bool(pairs))
        if not pairs:
            words = file.stem.removesuffix("_matches").split("_")
            pairs = [("_".join(words[:cut]), "_".join(words[cut:])) for cut in range(1, len(words))]
            pairs = [pair for pair in pairs if pair[0] in stems[0] and pair[1] in stems[1]]
        if len(pairs) > 1 or (pairs and places.setdefault(pairs[0], file) != file):
            got = f"several: add {' and '.join(_NAMES)}" if len(pairs) > 1 else f"that of {places[pairs[0]].name}"
            raise InputError(f"{file}: expected one pair of images, got {got}")
    if len(has_names) == 2 or not places:
        expected = f"a file .npz or .torch for each pair, with {' and '.join(_NAMES)} in all or in none"
        raise InputError(f"{path}: expected {expected}, got others; or give matches*.h5, or a database")

    def read(places: Sequence[Path]) -> Iterator[FileMatches]:
        for file in places:
            result = read_npz(file, _PARTS) if file.suffix == ".npz" else _read_torch(file)
            yield _matches_of(file, result, verified)

    return PairFiles(path, places, read, by_number=False, sided=has_names == {False}, in_image_files=False)


def open_predictions(path: Path, verified: bool = False) -> PairFiles:
    """A folder of predictions and their results; matches are points in To-Match's resized images."""
    places: dict[Pair, tuple[Path, int]] = {}
    for file in sorted(path.glob("*.torch")):
        query, predictions = read_predictions(file.with_suffix(".txt"))
        for position in range(len(_read_results(file, len(predictions)))):
            places.setdefault((query, predictions[position]), (file, position))

    def read(places: Sequence[tuple[Path, int]]) -> Iterator[FileMatches]:
        results_of = cache(_read_results)  # pairs of a query share a file
        yield from (_matches_of(file, results_of(file)[position], verified) for file, position in places)

    return PairFiles(path, places, read, by_number=False, in_image_files=False)


def read_predictions(path: Path) -> tuple[str, list[str]]:
    """Paths of a query and its predictions. Positives are not read: the data set has its own ground truth."""
    with reading(path, mend="expected a text file of predictions"):
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    parts: dict[str, list[str]] = {heading: [] for heading in ("", QUERY, PREDICTIONS, POSITIVES)}
    heading = ""
    for line in filter(None, map(str.strip, text.split("\n"))):
        if line in parts:
            heading = line
        else:
            parts[heading].append(printable(line))
    if parts[""] or len(parts[QUERY]) != 1 or not parts[PREDICTIONS]:
        expected = f"one path below {QUERY!r}, and one or more below {PREDICTIONS!r}"
        got = f"{len(parts[QUERY])} and {len(parts[PREDICTIONS])}; write them as VPR-methods-evaluation"
        raise InputError(f"{path}: expected {expected}, got {got}")
    return parts[QUERY][0], parts[PREDICTIONS]


def read_num_inliers(path: Path, most: int) -> list[float]:
    """Numbers of inliers of a query with its predictions, in their order; an InputError for more than `most`."""
    counts: list[Any] = [result.get("num_inliers") for result in _read_results(path, most)]
    if not counts or not all(type(count) is int and 0 <= count < 2**31 for count in counts):
        got = f"{shorten(str(counts))}; match again"
        raise InputError(f"{path}: expected num_inliers of each prediction, a whole number from 0, got {got}")
    return list(map(float, counts))


def _read_results(path: Path, most: int | None = None) -> list[dict[Any, Any]]:
    """A dictionary for each prediction, of at most `most`."""
    results = _read_torch(path, list)
    if not all(isinstance(result, dict) for result in results) or (most is not None and len(results) > most):
        expected = "a dictionary of To-Match for each prediction in the text file"
        raise InputError(f"{path}: expected {expected}, got {len(results)} results; match the predictions of this run")
    return results


def _read_torch(path: Path, kind: type = dict) -> Any:
    """Content of a file of `torch.save` without tensors: plain data and arrays."""
    with reading(path, mend="is it a result of vismatch or To-Match?"), path.open("rb") as file:
        with open_torch_archive(file) as (_, _, content):
            result = ArrayUnpickler(content).load()
        if not isinstance(result, kind):
            raise InputError(f"expected a {kind.__name__} of results, got {type(result).__name__}; match again")
        return result


def _matches_of(file: Path, result: Mapping[str, Any], verified: bool) -> FileMatches:
    """Matches of a result, or its inliers if `verified`."""
    parts = {name: np.asarray(part) for name, part in result.items() if name in _PARTS and part is not None}
    sizes, size_names = None, ("im_size", "im_size") if "im_size" in parts else _SIZES[:2]
    if {*size_names} & parts.keys():
        with reading(file, mend="expected image_size0 and image_size1 (width, height), or im_size, px"):
            size0, size1 = (np.broadcast_to(parts[name].astype(np.float64), 2).tolist() for name in size_names)
            sizes = (size0[0], size0[1]), (size1[0], size1[1])
    for first, second, confidence in (_INLIERS,) if verified else _LAYOUTS:
        if first in parts and second in parts:
            return FileMatches(parts[first], parts[second], parts.get(confidence), sizes)
    if not verified and {*_NUMBERED[:3]} <= parts.keys():
        (points0, points1, numbers), confidence = (parts[name] for name in _NUMBERED[:3]), parts.get(_NUMBERED[3])
        real = numbers >= 0
        shapes = {points0.shape[:1], numbers.shape, (numbers if confidence is None else confidence).shape}
        if len(shapes) > 1 or numbers.dtype.kind not in "iu" or (numbers[~real] != -1).any():
            expected = "matches [N] of keypoints0 [N, 2], a row of keypoints1 or -1"
            raise InputError(f"{file}: expected {expected}, got {numbers.dtype}{[*numbers.shape]}; match again")
        if real.any() and numbers.max() >= len(points1):
            raise InputError(f"{file}: expected matches below {len(points1)}, got {numbers.max()}; match again")
        confidence = None if confidence is None else confidence[real]
        return FileMatches(points0[real], points1[numbers[real]], confidence, sizes)
    expected = " and ".join(_INLIERS[:2]) if verified else "points0 and points1, or matched_kpts0 and matched_kpts1"
    raise InputError(f"{file}: expected {expected}, got {shorten(', '.join(sorted(parts))) or 'none'}")
