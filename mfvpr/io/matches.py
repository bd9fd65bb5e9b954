"""Read matches that other programs computed.

    files = open_matches("matches.h5", Images(query_names, features=queries), Images(database_names, features=database))
    matches = files.read(3, [14, 15])  # of query 3 with two database images

Matches are numbers of keypoints (hloc, kapture, COLMAP), or points (dense matchers of hloc, vismatch, `.npz`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from mfvpr.core.types import Features, Matches, Shortlist
from mfvpr.io.containers import FileEntry, as_float32, match_paths, require_one_image, shorten
from mfvpr.io.features import ImportedFeatures, require_inside
from mfvpr.io.pair_files import Pair, PairFiles, Size, open_pairs
from mfvpr.utils.errors import InputError

_ROUNDING = 1e-3  # by which a confidence may leave 0 to 1


class Images(NamedTuple):
    """Images of one side; their names are matched as in `containers.match_names`."""

    names: Sequence[str]  # relative POSIX paths, as `ImageFolder.names`
    paths: Sequence[str] = ()  # full paths, by which an image that is on both sides is known; () = unknown
    has_prefix: bool = False  # whether names have a prefix as in the file; without one, paths are tried before names
    size: Callable[[int], Size] | None = None  # of the image file of a row
    features: ImportedFeatures | None = None  # for files of matches without keypoints


class ImportedMatches:
    """Matches in files of another program, made by `open_matches`.

    `names` are those of queries and of database images in the file; None = it lacks the image. `numbered` tells whether
    matches have numbers of keypoints.
    """

    def __init__(
        self, files: PairFiles, sides: tuple[Images, Images], image_size: Size | None, confidences: bool
    ) -> None:
        self.path, self.numbered, self._files, self._sides = files.path, files.by_number, files, sides
        self._image_size, self._use_confidences = image_size, confidences
        self._has_confidences: bool | None = None  # of the pairs that were read; None = no matches yet
        names, known, images = [], {}, files.images
        for side, word in zip(sides, ("queries", "database images"), strict=True):
            paths = [] if side.has_prefix else [*map(files.spelling, side.paths)]
            matched = match_paths(self.path, [*map(files.spelling, side.names)], paths, images)
            if not files.sided and side.paths:
                entries = [None if name is None else FileEntry(self.path, name) for name in matched]
                require_one_image(self.path, [*map(Path, side.paths)], entries, known)
            if not any(matched):
                got = f"none of their names, such as {shorten(next(iter(images), 'none'))}"
                expected = f"matches of the {len(matched)} {word}"
                raise InputError(f"{self.path}: expected {expected}, got {got}; give the prefix of their folder")
            names.append(matched)
        self.names: tuple[list[str | None], list[str | None]] = (names[0], names[1])

    def contains(self, query: int, candidate: int) -> bool:
        """Whether the file has matches of a pair, in either order; they may be none."""
        return self._pair(query, candidate) is not None

    def read(self, query: int, candidates: Sequence[int]) -> list[Matches | None]:
        """Matches `[n]` of a query with each candidate, NumPy, without padding; None = the file lacks the pair.

        An `InputError` for damaged matches, or values beyond the keypoints, the images, or 0 to 1 for confidences.
        """
        pairs = {row: pair for row in candidates if (pair := self._pair(query, row)) is not None}
        contents = self._files.read([self._files.places[pair] for pair in pairs.values()])
        features = self._features(0, [query]) | self._features(1, [*pairs]) if self.numbered and pairs else {}
        matches = {}
        for (row, pair), content in zip(pairs.items(), contents, strict=True):
            first, second, confidence, sizes = content
            if pair != (self.names[0][query], self.names[1][row]):  # in the other order
                first, second, sizes = second, first, sizes and sizes[::-1]
            where = f"{self.path}: {shorten(str(self.names[0][query]))} and {shorten(str(self.names[1][row]))}"
            if not self._use_confidences or not first.size:
                confidence = None
            elif self._has_confidences not in (None, confidence is not None):
                raise InputError(f"{where}: expected confidences of all pairs or none, got some; set confidences=False")
            else:
                self._has_confidences = confidence is not None
            if self.numbered:
                sides: Any = features[0, query], features[1, row]
                matches[row] = numbered_matches(where, first, second, confidence, *sides)
            else:
                size0, size1 = sizes or (None, None)
                sides = self._size(0, query, size0), self._size(1, row, size1)
                matches[row] = point_matches(where, first, second, confidence, *sides)
        return list(map(matches.get, candidates))

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

    def _pair(self, query: int, candidate: int) -> Pair | None:
        """Names of a pair in the file's order."""
        first, second = self.names[0][query], self.names[1][candidate]
        orders = () if first is None or second is None else ((first, second), (second, first))
        return next((pair for pair in orders[: 1 if self._files.sided else 2] if pair in self._files.places), None)

    def _features(self, side: int, rows: list[int]) -> dict[tuple[int, int], Features]:
        """Features of images of a side, by side and row."""
        if (imported := self._sides[side].features) is not None:
            return {(side, row): features for row, features in imported.read(rows)}
        features, files = {}, self._files
        for row in rows:
            name = str(self.names[side][row])
            size = np.array(self._size(side, row, files.image_size and files.image_size(name)), np.float32)
            where = f"{self.path}: keypoints of {shorten(name)}"
            points = as_float32(where, np.asarray(files.keypoints(name) if files.keypoints else None))
            require_inside(where, points, size)
            features[side, row] = Features.of(points, np.zeros((len(points), 0), np.float32), image_size=size)
        return features

    def _size(self, side: int, row: int, stored: Size | None) -> Size:
        """Size of the image that points are in; an InputError if nobody knows it."""
        if stored is not None and self._image_size is not None and tuple(stored) != tuple(self._image_size):
            expected = f"the argument image_size={list(self._image_size)}"
            raise InputError(f"{self.path}: expected {expected}, got {list(stored)}; leave image_size out")
        size_of = self._sides[side].size if self._files.in_image_files else None
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
        InputError: a damaged file, another format, ambiguous names, no pair of these images, or missing features.
    """
    files = open_pairs(Path(path), (queries.names, database.names), verified)
    features = [side.features for side in (queries, database) if side.features is not None]
    needed = 2 if files.by_number and files.keypoints is None else 0
    if len(features) != needed:
        expected, mend = ("of both sides", "give hloc's feats*.h5") if needed else ("of no side", "leave them out")
        raise InputError(f"{path}: expected features {expected}, got {len(features)}; {mend}")
    return ImportedMatches(files, (queries, database), image_size, confidences)


def numbered_matches(
    where: str, first: Any, second: Any, confidence: Any, features0: Features, features1: Features
) -> Matches:
    """Matches `[M]` from numbers `[M]` of keypoints of `features0` and `features1`, which have no padding.

    `confidence` is `[M]`, from 0 to 1; None = 1. Distances are 0 without descriptors. `where` is for messages.
    """
    sides, numbers = (features0, features1), [np.asarray(values) for values in (first, second)]
    for values, features in zip(numbers, sides, strict=True):
        is_number = not values.size or (values.ndim == 1 and values.dtype.kind in "iu")
        if not is_number or (values < 0).any() or (values >= len(features.mask)).any():
            got = f"{values.dtype} {shorten(str(values))}; give the features that were matched"
            raise InputError(f"{where}: expected numbers of {len(features.mask)} keypoints [M], got {got}")
    number0, number1 = (values.astype(np.int32).reshape(-1) for values in numbers)
    dimensions = [np.shape(features.descriptors)[1] for features in sides]
    if len(number0) != len(number1) or dimensions[0] != dimensions[1]:
        got = f"{len(number0)} and {len(number1)} numbers, {dimensions[0]} and {dimensions[1]} dimensions"
        raise InputError(f"{where}: expected pairs of keypoints with descriptors of one length, got {got}")
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
    sides = []
    for values, size in ((first, size0), (second, size1)):
        points = as_float32(f"{where}: points", np.asarray(values), "fiu")
        points, size = points if points.size else np.zeros((0, 2), np.float32), np.array(size, np.float32)
        if points.shape[1:] != (2,) or (sides and len(points) != len(sides[0].mask)):
            got = f"{[*np.shape(first)]} and {[*np.shape(second)]}"
            raise InputError(f"{where}: expected as many points (x, y) [M, 2] in both images, got {got}")
        require_inside(where, points, size)
        sides.append(Features.of(points, np.zeros((len(points), 0), np.float32), image_size=size))
    numbers = np.arange(len(sides[0].mask))
    matches = numbered_matches(where, numbers, numbers, confidence, *sides)
    return replace(matches, index0=None, index1=None, count0=None, count1=None)


def _confidences(where: str, confidence: Any, count: int) -> Float32[np.ndarray, " matches"]:
    if confidence is None:
        return np.ones(count, np.float32)
    values = as_float32(f"{where}: confidences", np.asarray(confidence), "fiu")
    if values.shape != (count,) or (np.abs(values - 0.5) > 0.5 + _ROUNDING).any():
        got, mend = f"{[*values.shape]} from {values.min(initial=1):g} to {values.max(initial=0):g}", "scale them"
        raise InputError(f"{where}: expected {count} confidences from 0 to 1, got {got}; {mend}, or confidences=False")
    return np.clip(values, 0, 1)
