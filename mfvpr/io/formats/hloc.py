"""Read the matches of hloc's HDF5 files: a group `IMAGE/IMAGE` for each pair, with `-` for each `/` of the names."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader
from mfvpr.io.h5 import H5File
from mfvpr.utils.errors import InputError

_NUMBERS = ("matches0", "matching_scores0")  # of a matcher of features
_POINTS = ("keypoints0", "keypoints1", "scores")  # of a dense matcher, in the px of the image files


class HlocPairs(PairReader):
    """Reader of an hloc file of matches; names have `/` for each `-`."""

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, H5File(path)
        groups = [group for group in self._file.images if group.count("/") == 1]
        [arrays] = self._file.shapes(groups[:1], ()) if groups else [{}]
        if not {"matches0", "keypoints0"} & {*arrays}:
            raise InputError(
                f"{path}: expected groups IMAGE/IMAGE of matches, as hloc writes them since 2021, got others; give "
                "matches*.h5, not feats*.h5, or match again"
            )
        self.by_number = "keypoints0" not in arrays
        self._groups = {tuple(map(self.spelling, group.split("/"))): group for group in groups}
        if len(self._groups) < len(groups):
            raise InputError(f"{path}: expected different names of images, got two that differ by - and / alone")
        self.images = tuple(dict.fromkeys(name for pair in self._groups for name in pair))

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._groups

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        groups = [self._groups[pair] for pair in pairs]
        required = _NUMBERS[:1] if self.by_number else _POINTS[:2]
        for group, arrays in zip(groups, self._file.arrays(groups, _NUMBERS + _POINTS), strict=True):
            where = f"{self.path}: {shorten(group)}"
            if not {*required} <= arrays.keys():
                raise InputError(f"{where}: expected {' and '.join(required)}, got {', '.join(arrays) or 'none'}")
            if self.by_number:
                yield _numbered(where, arrays["matches0"], arrays.get("matching_scores0"))
            else:
                yield FileMatches(arrays["keypoints0"], arrays["keypoints1"], arrays.get("scores"))

    def spelling(self, name: str) -> str:
        return name.replace("-", "/")


def _numbered(where: str, numbers: np.ndarray, scores: np.ndarray | None) -> FileMatches:
    """Matches from the number of each keypoint's partner, -1 = none."""
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or (scores is not None and scores.shape != numbers.shape):
        got = f"{numbers.dtype}{list(numbers.shape)} and {'none' if scores is None else list(scores.shape)}"
        raise InputError(f"{where}: expected matches0 [N] of integers and matching_scores0 [N], got {got}")
    if (numbers < -1).any():
        raise InputError(
            f"{where}: expected numbers of keypoints from 0, or -1, got {numbers.min()}; hloc writes int16, so match at"
            " most 32768 keypoints"
        )
    first = np.flatnonzero(numbers >= 0)
    return FileMatches(first, numbers[first], None if scores is None else scores[first])
