"""Read folders with a file of results for each pair (`.npz`, vismatch's `.torch`) or for each query (To-Match's).

VPR-methods-evaluation writes a text file of predictions for each query. To-Match adds a `.torch` file beside it, with a
result for each prediction. PyTorch is not needed.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mfvpr.io.containers import read_npz, reading, shorten
from mfvpr.io.object_files import ArrayUnpickler, open_torch_archive
from mfvpr.io.pair_files import FileMatches, Pair, PairReader
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable

QUERY, PREDICTIONS, POSITIVES = "Query path:", "Predictions paths:", "Positives paths:"  # headings
_NAMES = ("img0_path", "img1_path")  # vismatch's
_LAYOUTS = (("points0", "points1", "confidence"), ("matched_kpts0", "matched_kpts1", "matched_confidences"))
_INLIERS = ("inlier_kpts0", "inlier_kpts1", "")
_NUMBERED = ("keypoints0", "keypoints1", "matches", "match_confidence")  # SuperGlue's
_SIZES = ("image_size0", "image_size1", "im_size")  # the last: side of vismatch's square images
_PARTS = {*_NAMES, *chain(*_LAYOUTS), *_INLIERS, *_NUMBERED, *_SIZES}

Parts = Mapping[str, Any]


class ResultFiles(PairReader):
    """Reader of a folder of files, which have the names of the images in them or in their own names.

    `SuperGlue` names a file `STEM_STEM_matches.npz`, with the query first. Such names have no folders, so that queries
    and database images may have the same names: `sided`.
    """

    by_number, in_image_files = False, False

    def __init__(self, path: Path, names: tuple[Sequence[str], Sequence[str]], verified: bool = False) -> None:
        self._verified = verified
        files = sorted(file for file in path.iterdir() if file.suffix in (".npz", ".torch"))
        stems = [{PurePosixPath(name).stem for name in side} for side in names]
        places: dict[Pair, Path] = {}
        has_names = set()  # whether files name their images
        for file in files:
            parts = read_npz(file, _NAMES) if file.suffix == ".npz" else _read_torch(file)
            inside = [str(parts[name]) for name in _NAMES if name in parts]
            has_names.add(len(inside) == 2)
            pair = (inside[0], inside[1]) if len(inside) == 2 else _names_of_file(file, stems)
            if pair is not None and places.setdefault(pair, file) != file:
                raise InputError(f"{file}: expected another pair than in {places[pair].name}; remove either")
        if len(has_names) == 2:
            raise InputError(f"{path}: expected {' and '.join(_NAMES)} in all files or in none, got both")
        if not places:
            raise InputError(
                f"{path}: expected a file .npz or .torch for each pair of images, got {len(files)} files of other "
                "images; give the file matches*.h5, the database, or the folder of matches"
            )
        self.sided = has_names == {False}
        super().__init__(path, places)

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        for file in (self.places[pair] for pair in pairs):
            result = read_npz(file, _PARTS) if file.suffix == ".npz" else _read_torch(file)
            yield _matches_of(file, result, self._verified)


class PredictionPairs(PairReader):
    """Reader of a folder of predictions and their results; matches are points in To-Match's resized images."""

    by_number, in_image_files = False, False

    def __init__(self, path: Path, verified: bool = False) -> None:
        self._verified = verified
        places: dict[Pair, tuple[Path, int]] = {}
        for file in sorted(path.glob("*.torch")):
            query, predictions = read_predictions(file.with_suffix(".txt"))
            for position in range(len(_read_results(file, len(predictions)))):
                places.setdefault((query, predictions[position]), (file, position))
        super().__init__(path, places)

    @staticmethod
    def fits(folder: Path) -> bool:
        """Whether a folder has results beside predictions."""
        return any(file.with_suffix(".txt").exists() for file in folder.glob("*.torch"))

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        read_results = cache(_read_results)  # pairs of a query share a file
        for file, position in (self.places[pair] for pair in pairs):
            yield _matches_of(file, read_results(file)[position], self._verified)


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
        raise InputError(
            f"{path}: expected one path below {QUERY!r}, and one or more below {PREDICTIONS!r}, as "
            "VPR-methods-evaluation writes them"
        )
    return parts[QUERY][0], parts[PREDICTIONS]


def read_num_inliers(path: Path, most: int) -> list[float]:
    """Numbers of inliers of a query with its predictions, in their order; an InputError for more than `most`."""
    counts: list[Any] = [result.get("num_inliers") for result in _read_results(path, most)]
    if not counts or not all(type(count) is int and 0 <= count < 2**31 for count in counts):
        raise InputError(f"{path}: expected num_inliers of each prediction, a whole number from 0")
    return list(map(float, counts))


def _read_results(path: Path, most: int | None = None) -> list[dict[Any, Any]]:
    """A dictionary for each prediction, of at most `most`."""
    results = _read_torch(path, list)
    if not all(isinstance(result, dict) for result in results):
        raise InputError(f"{path}: expected a dictionary of To-Match for each prediction, got others")
    if most is not None and len(results) > most:
        got = f"{len(results)} results; match the predictions of this run"
        raise InputError(f"{path}: expected a result for each prediction in the text file, at most {most}, got {got}")
    return results


def _read_torch(path: Path, kind: type = dict) -> Any:
    """Content of a file of `torch.save` without tensors: plain data and arrays."""
    with reading(path, mend="is it a result of vismatch or To-Match?"), path.open("rb") as file:
        with open_torch_archive(file) as archive:
            result = ArrayUnpickler(archive.pickle).load()
        if not isinstance(result, kind):
            raise InputError(f"expected a {kind.__name__} of results, got {type(result).__name__}")
        return result


def _names_of_file(file: Path, stems: Sequence[set[str]]) -> Pair | None:
    """Stems of the query and the database image that a file is named after; None for other images."""
    words = file.stem.removesuffix("_matches").split("_")
    pairs = [("_".join(words[:cut]), "_".join(words[cut:])) for cut in range(1, len(words))]
    pairs = [pair for pair in pairs if pair[0] in stems[0] and pair[1] in stems[1]]
    if len(pairs) > 1:
        raise InputError(f"{file}: expected one pair of images, got several ways to read; add {' and '.join(_NAMES)}")
    return pairs[0] if pairs else None


def _matches_of(file: Path, result: Parts, verified: bool) -> FileMatches:
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
    if verified or not {*_NUMBERED[:3]} <= parts.keys():
        expected = " and ".join(_INLIERS[:2]) if verified else "points0 and points1, or matched_kpts0 and matched_kpts1"
        raise InputError(f"{file}: expected {expected}, got {shorten(', '.join(sorted(parts))) or 'none'}")
    keypoints0, keypoints1, numbers = (parts[name] for name in _NUMBERED[:3])
    confidence = parts.get(_NUMBERED[3])
    has_numbers = numbers.dtype.kind in "iu" and numbers.ndim == 1 and keypoints1.ndim == 2
    if not has_numbers or any(len(part) != len(numbers) for part in (keypoints0, confidence) if part is not None):
        raise InputError(
            f"{file}: expected keypoints0 [N, 2], keypoints1 [M, 2], matches [N] of integers, "
            "match_confidence [N], got others"
        )
    if (numbers < -1).any() or (numbers >= len(keypoints1)).any():
        raise InputError(f"{file}: expected matches from -1 to {len(keypoints1) - 1}, got others")
    real = numbers >= 0
    confidence = None if confidence is None else confidence[real]
    return FileMatches(keypoints0[real], keypoints1[numbers[real]], confidence, sizes)
