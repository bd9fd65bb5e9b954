"""Read matches that other programs computed.

    files = open_matches("matches.h5", Images(query_names, features=queries), Images(database_names, features=database))
    matches = files.read(3, [14, 15])  # of query 3 with two database images

Matches are numbers of keypoints (hloc, kapture, COLMAP), or points (dense matchers of hloc, vismatch, `.npz`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from mfvpr.core.types import Features, Matches, Shortlist
from mfvpr.io.containers import FileEntry, as_float32, choose_reader, shorten
from mfvpr.io.features import ImportedFeatures, require_inside
from mfvpr.io.names import match_paths, require_one_image
from mfvpr.io.pair_files import (
    ColmapPairs,
    FileMatches,
    HlocPairs,
    KapturePairs,
    Pair,
    PairReader,
    Size,
)
from mfvpr.io.result_files import PredictionPairs, ResultFiles
from mfvpr.utils.errors import InputError

_ROUNDING = 1e-3  # by which a confidence may leave 0 to 1


class Images(NamedTuple):
    """Images of one side.

    names: relative POSIX paths, as `ImageFolder.names`, matched as in `names.match_names`.
    paths: full paths, by which an image that is on both sides is known; () = unknown.
    has_prefix: whether names have a prefix as in the file; without one, paths are tried before the names.
    size: size of the image file of a row; None = unknown.
    features: of these images, for files of matches without keypoints.
    """

    names: Sequence[str]
    paths: Sequence[str] = ()
    has_prefix: bool = False
    size: Callable[[int], Size] | None = None
    features: ImportedFeatures | None = None


class ImportedMatches:
    """Matches in files of another program, made by `open_matches`.

    Attributes:
        path: file or folder.
        names: names in the file of queries and database images; None = the file lacks the image.
        numbered: whether matches have numbers of keypoints.
    """

    def __init__(
        self, reader: PairReader, sides: tuple[Images, Images], image_size: Size | None, confidences: bool
    ) -> None:
        self.path, self._reader, self._sides = reader.path, reader, sides
        self._image_size, self._use_confidences = image_size, confidences
        self._has_confidences: bool | None = None  # of the pairs that were read; None = no matches yet
        self.numbered = reader.by_number
        names, known = [], {}
        for side, word in zip(sides, ("queries", "database images"), strict=True):
            paths = [] if side.has_prefix else [*map(reader.spelling, side.paths)]
            matched = match_paths(reader.path, [*map(reader.spelling, side.names)], paths, reader.images)
            if not reader.sided and side.paths:
                entries = [None if name is None else FileEntry(reader.path, name) for name in matched]
                require_one_image(reader.path, [*map(Path, side.paths)], entries, known)
            if not any(matched):
                raise InputError(
                    f"{reader.path}: expected matches of the {len(matched)} {word}, got none of their names, such as "
                    f"{shorten(next(iter(reader.images), 'none'))}; give the prefix of their folder"
                )
            names.append(matched)
        self.names: tuple[list[str | None], list[str | None]] = (names[0], names[1])

    def contains(self, query: int, candidate: int) -> bool:
        """Whether the file has matches of a pair, in either order; they may be none."""
        return self._stored(query, candidate) is not None

    def read(self, query: int, candidates: Sequence[int]) -> list[Matches | None]:
        """Matches `[n]` of a query with each candidate, NumPy, without padding; None = the file lacks the pair.

        Raises:
            InputError: matches are damaged, beyond the keypoints or the images, or confidences beyond 0 to 1.
        """
        stored = {row: pair for row in candidates if (pair := self._stored(query, row)) is not None}
        contents = self._reader.read([pair for pair, _ in stored.values()])
        features = self._features(0, [query]) | self._features(1, [*stored]) if self.numbered and stored else {}
        matches = {}
        for (row, (_, is_exchanged)), content in zip(stored.items(), contents, strict=True):
            raw = content
            if is_exchanged:
                raw = FileMatches(raw.second, raw.first, raw.confidence, raw.sizes and (raw.sizes[1], raw.sizes[0]))
            where = f"{self.path}: {shorten(str(self.names[0][query]))} and {shorten(str(self.names[1][row]))}"
            uses_confidence = self._use_confidences and raw.first.size > 0
            confidence = raw.confidence if uses_confidence else None
            if uses_confidence:
                if self._has_confidences not in (None, confidence is not None):
                    raise InputError(f"{where}: expected confidences of all pairs or of none; set confidences=False")
                self._has_confidences = confidence is not None
            if self.numbered:
                sides: Any = features[0, query], features[1, row]
                matches[row] = numbered_matches(where, raw.first, raw.second, confidence, *sides)
            else:
                sizes = raw.sizes or (None, None)
                sides = self._size(0, query, sizes[0]), self._size(1, row, sizes[1])
                matches[row] = point_matches(where, raw.first, raw.second, confidence, *sides)
        return list(map(matches.get, candidates))

    def _stored(self, query: int, candidate: int) -> tuple[Pair, bool] | None:
        """Names of a pair in the file's order, and whether that is candidate, query."""
        first, second = self.names[0][query], self.names[1][candidate]
        if first is None or second is None:
            return None
        if (first, second) in self._reader.places:
            return (first, second), False
        return ((second, first), True) if not self._reader.sided and (second, first) in self._reader.places else None

    def warnings(self, shortlist: Shortlist) -> list[str]:
        """Warn in one line if pairs of a shortlist are missing; raise an InputError if all are."""
        pairs = [(query, int(shortlist.indices[query, place])) for query, place in np.argwhere(shortlist.mask).tolist()]
        missing = [pair for pair in pairs if not self.contains(*pair)]
        if not missing:
            return []
        query, row = missing[0]
        first = f"{shorten(self._sides[0].names[query])} and {shorten(self._sides[1].names[row])}"
        count = f"{len(missing)} of {len(pairs)} pairs of the shortlist"
        if len(missing) == len(pairs):
            raise InputError(f"{self.path}: expected matches of {count}, got none; the first is {first}")
        return [f"{self.path}: no matches of {count}, the first {first}; they score 0"]

    def _features(self, side: int, rows: list[int]) -> dict[tuple[int, int], Features]:
        """Features of images of a side, by side and row."""
        images = self._sides[side]
        if images.features is not None:
            return {(side, row): features for row, features in images.features.read(rows)}
        features = {}
        for row in rows:
            name = str(self.names[side][row])
            size = np.array(self._size(side, row, self._reader.image_size(name)), np.float32)
            where = f"{self.path}: keypoints of {shorten(name)}"
            points = as_float32(where, np.asarray(self._reader.keypoints(name)))
            require_inside(where, points, size)
            features[side, row] = Features.of(points, np.zeros((len(points), 0), np.float32), image_size=size)
        return features

    def _size(self, side: int, row: int, stored: Size | None) -> Size:
        """Size of the image that points are in; an InputError if nobody knows it."""
        if stored is not None and self._image_size is not None and tuple(stored) != tuple(self._image_size):
            expected = f"the argument image_size={list(self._image_size)}"
            raise InputError(f"{self.path}: expected {expected}, got {list(stored)}")
        size_of = self._sides[side].size if self._reader.in_image_files else None
        size = stored or self._image_size or (size_of and size_of(row))
        if size is None or not all(isinstance(length, int | float) and 0 < length < np.inf for length in size):
            got = f"{size and list(size)}; set image_size=[W,H]"
            raise InputError(f"{self.path}: expected the size of an image, width and height in px, got {got}")
        return size


def open_matches(
    path: Path | str,
    queries: Images,
    database: Images,
    *,
    image_size: Size | None = None,
    verified: bool = False,
    confidences: bool = True,
) -> ImportedMatches:
    """Open the matches of queries with database images; reads names, and no matches.

    Args:
        path: hloc's `matches*.h5`; COLMAP's `.db`; a kapture folder; a folder with a file for each pair, `.npz`, or
            `.torch` of vismatch; or VPR-methods-evaluation's `preds` with To-Match's `.torch` files.
        queries: names of the queries, and what is known of them.
        database: likewise; hloc's matches of features need the `features` of both sides.
        image_size: (width, height) of the images that points are in, px, if the file does not tell.
        verified: matches that fit a geometric model: COLMAP's `two_view_geometries`, vismatch's inliers.
        confidences: whether matches have the confidences of the file; if not, or without any, all are 1.

    Raises:
        InputError: the file is missing, damaged or has another format; names are ambiguous; there is no pair of a query
            and a database image; or features are missing.
    """
    path = Path(path)
    if not path.is_dir():
        kind = choose_reader(path, {".h5": HlocPairs, ".hdf5": HlocPairs, ".db": ColmapPairs})
        reader = ColmapPairs(path, verified) if kind is ColmapPairs else HlocPairs(path)
    elif KapturePairs.fits(path):
        reader = KapturePairs(path)
    elif PredictionPairs.fits(path):
        reader = PredictionPairs(path, verified)
    else:
        reader = ResultFiles(path, (queries.names, database.names), verified)
    if verified and isinstance(reader, HlocPairs | KapturePairs):
        raise InputError(f"{path}: expected COLMAP's .db, or results of vismatch or To-Match, with verified=True")
    if reader.by_number and not isinstance(reader, ColmapPairs | KapturePairs):
        if queries.features is None or database.features is None:
            raise InputError(f"{path}: expected the features that were matched, got none; give hloc's feats*.h5")
    elif queries.features is not None or database.features is not None:
        raise InputError(f"{path}: expected no features, since the file has its points; leave them out")
    return ImportedMatches(reader, (queries, database), image_size, confidences)


def content_paths(path: Path) -> list[Path]:
    """Files and folders that decide the matches in `path`, without links."""
    is_kapture = path.is_dir() and KapturePairs.fits(path)
    return [each.resolve() for each in (KapturePairs.folders(path) if is_kapture else [path])]


def numbered_matches(
    where: str, first: Any, second: Any, confidence: Any, features0: Features, features1: Features
) -> Matches:
    """Matches `[M]` from numbers `[M]` of keypoints of `features0` and `features1`, which have no padding.

    `confidence` is `[M]`, from 0 to 1; None = 1. Distances are 0 without descriptors. `where` is for messages.
    """
    numbers = []
    for values, features in ((first, features0), (second, features1)):
        values = np.asarray(values) if np.size(values) else np.zeros(0, np.int32)
        if values.ndim != 1 or values.dtype.kind not in "iu":
            raise InputError(f"{where}: expected numbers of keypoints [M], got {values.dtype}{list(values.shape)}")
        if values.size and not 0 <= values.min() <= values.max() < len(features.mask):
            got = f"{values.min()} to {values.max()}; give the features that were matched"
            raise InputError(f"{where}: expected numbers of {len(features.mask)} keypoints, got {got}")
        numbers.append(values.astype(np.int32))
    number0, number1 = numbers
    if len(number0) != len(number1):
        raise InputError(f"{where}: expected pairs of keypoints, got {len(number0)} and {len(number1)} numbers")
    dimensions = [np.shape(features.descriptors)[1] for features in (features0, features1)]
    if dimensions[0] != dimensions[1]:
        raise InputError(f"{where}: expected descriptors of one length, got {dimensions[0]} and {dimensions[1]}")
    differences = np.asarray(features0.descriptors)[number0] - np.asarray(features1.descriptors)[number1]
    return Matches(
        points0=features0.keypoints[number0],
        points1=features1.keypoints[number1],
        distance=np.linalg.norm(differences, axis=1).astype(np.float32),
        scores0=features0.scores[number0],
        scores1=features1.scores[number1],
        mask=np.ones(len(number0), bool),
        image_size0=features0.image_size,
        image_size1=features1.image_size,
        confidence=_confidences(where, confidence, len(number0)),
        index0=number0,
        index1=number1,
        count0=np.int32(len(features0.mask)),
        count1=np.int32(len(features1.mask)),
    )


def point_matches(where: str, first: Any, second: Any, confidence: Any, size0: Size, size1: Size) -> Matches:
    """Matches `[M]` from points `[M, 2]` (x, y) in images of these sizes, px; their distances are 0, their scores 1."""
    points, sizes = [], [np.array(size, np.float32) for size in (size0, size1)]
    for values, size in zip((first, second), sizes, strict=True):
        values = as_float32(f"{where}: points", np.asarray(values), "fiu")
        values = values if values.size else np.zeros((0, 2), np.float32)
        if values.ndim != 2 or values.shape[1] != 2:
            raise InputError(f"{where}: expected points (x, y) [M, 2], got {list(values.shape)}")
        require_inside(where, values, size)
        points.append(values)
    if len(points[0]) != len(points[1]):
        raise InputError(f"{where}: expected as many points in both images, got {len(points[0])} and {len(points[1])}")
    ones = np.ones(len(points[0]), np.float32)
    return Matches(
        points0=points[0],
        points1=points[1],
        distance=np.zeros_like(ones),
        scores0=ones,
        scores1=ones,
        mask=ones > 0,
        image_size0=sizes[0],
        image_size1=sizes[1],
        confidence=_confidences(where, confidence, len(ones)),
    )


def _confidences(where: str, confidence: Any, count: int) -> Float32[np.ndarray, " matches"]:
    if confidence is None:
        return np.ones(count, np.float32)
    values = as_float32(f"{where}: confidences", np.asarray(confidence), "fiu")
    if values.shape != (count,):
        raise InputError(f"{where}: expected {count} confidences, got {list(values.shape)}")
    if count and not -_ROUNDING <= values.min() <= values.max() <= 1 + _ROUNDING:
        got = f"{values.min():g} to {values.max():g}; scale them, or leave them out (confidences=False for files)"
        raise InputError(f"{where}: expected confidences from 0 to 1, got {got}")
    return np.clip(values, 0, 1)
