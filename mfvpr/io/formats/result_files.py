"""Read folders with a file of matches for each pair: `.npz`, or `.torch` as vismatch writes them."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from mfvpr.io.containers import reading, shorten
from mfvpr.io.formats.numpy_objects import Array, ArrayUnpickler
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader, Size
from mfvpr.io.formats.pickles import Name, name_error
from mfvpr.io.formats.torch_archives import open_torch_archive
from mfvpr.io.npz import read_npz
from mfvpr.utils.errors import InputError

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
        self.path, self._verified = path, verified
        files = sorted(file for file in path.iterdir() if file.suffix in (".npz", ".torch"))
        stems = tuple({PurePosixPath(name).stem for name in side} for side in names)
        named = {file: _names_inside(file) for file in files}
        self.sided = not all(named.values())
        if self.sided and any(named.values()):
            raise InputError(f"{path}: expected {' and '.join(_NAMES)} in all files or in none, got both")
        pairs = {file: pair or _names_of_file(file, stems) for file, pair in named.items()}
        self._files: dict[Pair, Path] = {}
        for file, pair in pairs.items():
            if pair is not None and self._files.setdefault(pair, file) != file:
                raise InputError(f"{file}: expected another pair than in {self._files[pair].name}; remove either")
        if not files:
            raise InputError(f"{path}: expected files .npz or .torch of matches, got none; give the file matches*.h5, "
                             "the database, or the folder of matches")  # fmt: skip
        if not self._files:
            raise InputError(f"{path}: expected a file .npz or .torch for each pair of images, got {len(files)} files "
                             "of other images; see mfvpr/io/README.md")  # fmt: skip
        self.images = tuple(dict.fromkeys(chain(*self._files)))
        self.has_confidences = self.find_confidences([*self._files])

    def __contains__(self, pair: Pair) -> bool:
        return pair in self._files

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        for pair in pairs:
            yield result_matches(self._files[pair], _read(self._files[pair]), self._verified)


class _ResultUnpickler(ArrayUnpickler):
    """Unpickler of vismatch's results: paths become text."""

    def call(self, name: Name, arguments: tuple) -> Any:
        if name.module.split(".")[0] == "pathlib" and all(isinstance(part, str) for part in arguments):
            if name.name in ("PosixPath", "PurePosixPath"):
                return str(PurePosixPath(*arguments))
            if name.name in ("WindowsPath", "PureWindowsPath"):
                return PureWindowsPath(*arguments).as_posix()
        return super().call(name, arguments)

    def persistent_load(self, pid: Any) -> Any:
        raise name_error(Name("torch", "Tensor"), "arrays of NumPy")


def _read(file: Path) -> Parts:
    if file.suffix == ".npz":
        return read_npz(file, _PARTS)
    with reading(file, mend="is it a result of vismatch?"), file.open("rb") as content:
        with open_torch_archive(content) as archive:
            result = _ResultUnpickler(archive.pickle).load()
        if not isinstance(result, dict):
            raise InputError(f"expected a dictionary of results, got {type(result).__name__}")
        return plain_parts(result)


def plain_parts(result: Mapping[Any, Any]) -> Parts:
    """Arrays of an unpickled result that matter here."""
    parts = {name: part for name, part in result.items() if name in _PARTS and part is not None}
    return {name: part.numbers() if isinstance(part, Array) else np.asarray(part) for name, part in parts.items()}


def _names_inside(file: Path) -> Pair | None:
    """Names of the two images, if the file has them."""
    parts = read_npz(file, _NAMES) if file.suffix == ".npz" else _read(file)
    names = [str(parts[name]) for name in _NAMES if name in parts]
    if len(names) == 1:
        raise InputError(f"{file}: expected {' and '.join(_NAMES)}, got one of them")
    return (names[0], names[1]) if names else None


def _names_of_file(file: Path, stems: tuple[set[str], ...]) -> Pair | None:
    """Stems of the query and the database image that a file is named after; None for other images."""
    name = file.stem.removesuffix("_matches")
    cuts = [place for place, letter in enumerate(name) if letter == "_"]
    pairs = [(name[:cut], name[cut + 1 :]) for cut in cuts]
    pairs = [pair for pair in pairs if pair[0] in stems[0] and pair[1] in stems[1]]
    if len(pairs) > 1:
        raise InputError(f"{file}: expected the stems of a query and a database image, got several ways to read; add "
                         f"the arrays {' and '.join(_NAMES)}")  # fmt: skip
    return pairs[0] if pairs else None


def result_matches(file: Path, parts: Parts, verified: bool) -> FileMatches:
    """Matches of a result, or its inliers if `verified`."""
    sizes = _sizes(file, parts)
    for first, second, confidence in (_INLIERS,) if verified else _LAYOUTS:
        if first in parts and second in parts:
            return FileMatches(parts[first], parts[second], parts.get(confidence), sizes)
    keypoints0, keypoints1, numbers, confidence = map(parts.get, _NUMBERED)
    if verified or keypoints0 is None or keypoints1 is None or numbers is None:
        expected = " and ".join(_INLIERS[:2]) if verified else "points0 and points1, or matched_kpts0 and matched_kpts1"
        raise InputError(f"{file}: expected {expected}, got {shorten(', '.join(sorted(parts))) or 'none'}")
    shapes = [values.shape for values in (keypoints0, keypoints1, numbers, confidence) if values is not None]
    if [*map(len, shapes)] != [2, 2, 1, 1][: len(shapes)] or len({shape[0] for shape in (shapes[0], *shapes[2:])}) > 1:
        raise InputError(f"{file}: expected keypoints0 [N, 2], keypoints1 [M, 2], matches [N], match_confidence [N], "
                         f"got {', '.join(map(str, shapes))}")  # fmt: skip
    if numbers.dtype.kind not in "iu":
        raise InputError(f"{file}: expected matches of integers, got {numbers.dtype}")
    real = numbers >= 0
    if (numbers < -1).any() or (numbers >= len(keypoints1)).any():
        raise InputError(f"{file}: expected matches from -1 to {len(keypoints1) - 1}, got others")
    return FileMatches(
        keypoints0[real], keypoints1[numbers[real]], None if confidence is None else confidence[real], sizes
    )


def _sizes(file: Path, parts: Parts) -> tuple[Size, Size] | None:
    side = parts.get("im_size")
    sizes = [side, side] if side is not None else [parts[name] for name in _SIZES[:2] if name in parts]
    if not sizes:
        return None
    try:
        (size0, size1) = (np.broadcast_to(np.asarray(size, np.float64), 2) for size in sizes)
    except (OverflowError, TypeError, ValueError):
        raise InputError(f"{file}: expected image_size0 and image_size1 (width, height), or im_size, px") from None
    return (float(size0[0]), float(size0[1])), (float(size1[0]), float(size1[1]))
