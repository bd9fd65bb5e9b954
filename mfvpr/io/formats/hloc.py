"""Read the matches of hloc's HDF5 files: a group `IMAGE/IMAGE` for each pair, with `-` for each `/` of the names."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mfvpr.io.containers import Shapes, shorten
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader
from mfvpr.io.h5 import H5Pairs
from mfvpr.utils.errors import InputError

_NUMBERS = ("matches0", "matching_scores0")  # of a matcher of features
_POINTS = ("keypoints0", "keypoints1", "scores")  # of a dense matcher, in the px of the image files


class HlocPairs(PairReader):
    """Reader of an hloc file of matches; names have `/` for each `-`."""

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, H5Pairs(path)
        arrays = _arrays_of_first(self._file)
        if not {"matches0", "keypoints0"} & {*arrays}:
            raise InputError(f"{path}: expected groups IMAGE/IMAGE of matches, as hloc writes them since 2021, got "
                             "others; give matches*.h5, not feats*.h5, or match again")  # fmt: skip
        self._groups = {tuple(map(self.spelling, group.split("/"))): group for group in self._file.images}
        if len(self._groups) < len(self._file.images):
            raise InputError(f"{path}: expected different names of images, got two that differ by - and / alone")
        self.images = tuple(dict.fromkeys(name for pair in self._groups for name in pair))
        self.by_number = "keypoints0" not in arrays
        self.has_confidences = ("matching_scores0" if self.by_number else "scores") in arrays

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._groups

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        groups = [self._groups[pair] for pair in pairs]
        for group, arrays in zip(groups, self._file.arrays(groups, _NUMBERS + _POINTS), strict=True):
            required = _NUMBERS[:1] if self.by_number else _POINTS[:2]
            if missing := [name for name in required if name not in arrays]:
                raise InputError(f"{self.path}: {shorten(group)}: expected {' and '.join(required)}, got no "
                                 f"{missing[0]}; match again")  # fmt: skip
            if not self.by_number:
                yield FileMatches(arrays["keypoints0"], arrays["keypoints1"], arrays.get("scores"))
                continue
            numbers, scores = arrays["matches0"], arrays.get("matching_scores0")
            yield _numbered(f"{self.path}: {shorten(group)}", numbers, scores)

    def spelling(self, name: str) -> str:
        return name.replace("-", "/")


def _arrays_of_first(file: H5Pairs) -> Shapes:
    """Arrays of the first pair; none if it is no group."""
    try:
        return next(file.shapes(file.images[:1], ()), {})
    except InputError:
        return {}


def _numbered(where: str, numbers: np.ndarray, scores: np.ndarray | None) -> FileMatches:
    """Matches from the number of each keypoint's partner, -1 = none."""
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or (scores is not None and scores.shape != numbers.shape):
        got = f"{numbers.dtype}{list(numbers.shape)} and {'none' if scores is None else list(scores.shape)}"
        raise InputError(f"{where}: expected matches0 [N] of integers and matching_scores0 [N], got {got}")
    if (numbers < -1).any():
        raise InputError(f"{where}: expected numbers of keypoints from 0, or -1, got {numbers.min()}; hloc writes "
                         "int16, so match at most 32768 keypoints")  # fmt: skip
    first = np.flatnonzero(numbers >= 0)
    return FileMatches(first, numbers[first], None if scores is None else scores[first])
