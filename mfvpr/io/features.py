"""Local features that other programs extracted, read when they are asked for.

    features = open_features(Path("feats-d2net-ss.h5"), dataset.database.names)
    for row, found in features.read([3, 14]):
        ...

What is read: hloc's h5; an npz for all images, with arrays named `image/part`; a folder with an npz for each image,
D2-Net's own `.d2-net` among them. Parts are `keypoints` `[N, 2]` (x, y), px, or with up to two more columns (scale,
angle), which are not used; `descriptors` `[D, N]` (hloc) or `[N, D]`; `scores` or `keypoint_scores` `[N]`, larger =
better; `image_size` `[2]` (width, height), px, of the image that the keypoints are in. Pixel centers are at whole
numbers, as in hloc and OpenCV; hloc gives keypoints in the original image, whatever size it was reduced to.

Where the file has no scores, every keypoint has the score 1. float16 becomes float32; positions that hloc rounded to
float16 are off by up to 0.25 px beyond 512 px and 0.5 px beyond 1024 px.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.io.checks import Lengths, as_float32, require_lengths, with_length
from mfvpr.io.containers import Container, Contents, FileEntry, shortened
from mfvpr.io.h5 import H5File
from mfvpr.io.names import match_names, require_all
from mfvpr.io.npz import NpzFile, NpzFolder
from mfvpr.types import Features
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file

SCORES = ("scores", "keypoint_scores")
PARTS = ("keypoints", "descriptors", *SCORES, "image_size")


@dataclass(frozen=True, eq=False)
class ImportedFeatures:
    """Features of M images in files of another program, made by `open_features`.

    Attributes:
        path: file or folder.
        paths: the files that hold the images.
        counts: `[M]` int32, keypoints of each image, -1 = not there.
        dimension: D; 0 where no image has a keypoint.
        scored: whether the files have scores; if not, all are 1.
    """

    path: Path
    paths: tuple[Path, ...]
    counts: np.ndarray
    dimension: int
    scored: bool
    _container: Container
    _images: tuple[str | None, ...]
    _transposed: bool
    _sizes: np.ndarray | None
    _lengths: Lengths

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def entries(self) -> list[FileEntry | None]:
        """`[M]` place of each image's arrays; None = not there."""
        return [None if image is None else self._container.entry(image) for image in self._images]

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """Row and features, unpadded NumPy float32 with a full mask, in the order of `rows`; nothing else is read.

        Args:
            rows: None = all that are there.

        Raises:
            InputError: an image that is not there, or whose arrays are damaged or not what they should be.
        """
        wanted = np.flatnonzero(self.counts >= 0).tolist() if rows is None else [int(row) for row in rows]
        images = [self._image(row) for row in wanted]
        arrays = self._container.arrays(images, PARTS)
        for row, image, parts in zip(wanted, images, arrays, strict=True):
            yield row, self._features(row, f"{self.path}: {shortened(image)}", parts)

    def _image(self, row: int) -> str:
        image = self._images[row] if 0 <= row < len(self) else None
        if image is None:
            raise InputError(f"{self.path}: expected features of image {row}, got none; see counts")
        return image

    def _features(self, row: int, where: str, parts: Mapping[str, np.ndarray]) -> Features:
        count, shape = int(self.counts[row]), (int(self.counts[row]), self.dimension)
        _require_parts(where, parts)
        keypoints = as_float32(f"{where}: keypoints", parts["keypoints"], "fiu")[:, :2]
        descriptors = as_float32(f"{where}: descriptors", parts["descriptors"])
        descriptors = descriptors.T if self._transposed else descriptors
        scores = np.ones(count, np.float32)
        if part := _score_part(parts):
            scores = as_float32(f"{where}: {part}", parts[part]).reshape(-1)
        fit = descriptors.shape == shape if count else not descriptors.size  # [D, 0], [0, D], [0]: all are none
        if len(keypoints) != count or len(scores) != count or not fit or self.scored != (part is not None):
            raise InputError(
                f"{where}: expected {count} keypoints with scores and descriptors of "
                f"{self.dimension} numbers, got {len(keypoints)}, {len(scores)} and {list(descriptors.shape)}; is the "
                "file damaged, or has it changed since it was opened?"
            )
        size = _image_size(where, parts.get("image_size"), None if self._sizes is None else self._sizes[row])
        _require_inside(where, keypoints, size)
        return Features(
            keypoints=np.ascontiguousarray(keypoints),
            descriptors=np.ascontiguousarray(
                with_length(f"{where}: descriptors", descriptors.reshape(shape), self._lengths)
            ),
            scores=scores,
            mask=np.ones(count, bool),
            image_size=size,
        )


def open_features(
    path: Path | str,
    names: Sequence[str],
    *,
    image_size: Any = None,
    lengths: Lengths = "unit",
    partial: bool = False,
) -> ImportedFeatures:
    """Features of the images `names`. Only the headers of their arrays are read here.

    Args:
        path: `.h5` or `.hdf5` of hloc, `.npz` of all images, or a folder of `.npz` and `.d2-net`.
        names: `[M]` relative POSIX paths, as `ImageFolder.names`; see `names.match_names`. Where hloc saw the folder of
            the images from above (`database/1.jpg`), give them so.
        image_size: `[2]` or `[M, 2]` (width, height), px, of images whose size the files do not tell.
        lengths: of descriptors. `unit`: they must be of unit length within 1 %, and rounding is mended; `normalize`:
            they are given unit length; `keep`: they are taken as they are.
        partial: whether images may be missing (their count is -1).

    Raises:
        InputError: no such file, not of this kind, damaged; images that are missing or could be several; arrays that do
            not fit each other.
    """
    path = Path(path)
    require_lengths(lengths)
    sizes = None if image_size is None else _given_sizes(image_size, len(names))
    container = open_container(path)
    images = match_names(path, names, container.images)
    if not partial or not any(images):
        require_all(path, names, images, "features")
    there = [row for row, image in enumerate(images) if image is not None]
    matched = [image for image in images if image is not None]
    contents = dict(zip(matched, container.contents(matched, ("keypoints", "descriptors")), strict=True))
    counts = np.full(len(names), -1, np.int32)
    for row, (image, held) in zip(there, contents.items(), strict=True):
        counts[row] = _count(f"{path}: {shortened(image)}", held, given_size=sizes is not None)
    transposed, dimension = _layout(path, contents, container.transposed)
    return ImportedFeatures(
        path=path,
        paths=tuple(dict.fromkeys(container.entry(image).file for image in matched)),
        counts=counts,
        dimension=dimension,
        scored=_scored(path, contents),
        _container=container,
        _images=tuple(images),
        _transposed=transposed,
        _sizes=sizes,
        _lengths=lengths,
    )


def open_container(path: Path) -> Container:
    """Whatever holds arrays by image: chosen by the name of the file, or a folder."""
    if path.is_dir():
        return NpzFolder(path)
    require_file(path)
    readers = {".h5": H5File, ".hdf5": H5File, ".npz": NpzFile}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a folder or a file named {', '.join(readers)}, got {path.suffix or 'none'}")
    return readers[path.suffix.lower()](path)


def _require_parts(where: str, parts: Collection[str]) -> None:
    if missing := [part for part in ("keypoints", "descriptors") if part not in parts]:
        raise InputError(f"{where}: expected keypoints and descriptors, got no {' and no '.join(missing)}")


def _count(where: str, held: Contents, *, given_size: bool) -> int:
    """How many keypoints there are."""
    _require_parts(where, held.names)
    shape = held.shapes["keypoints"]
    if len(shape) != 2 or not 2 <= shape[1] <= 4 or shape[0] > np.iinfo(np.int32).max:
        raise InputError(
            f"{where}: keypoints: expected [N, 2], (x, y), with at most scale and angle, got {list(shape)}"
        )
    if "image_size" not in held.names and not given_size:
        raise InputError(f"{where}: expected image_size (width, height) in the file, got none; give it as image_size=")
    return shape[0]


def _layout(path: Path, contents: Mapping[str, Contents], default: bool) -> tuple[bool, int]:
    """Whether descriptors are `[D, N]`, and D: the same for all images.

    An image with N = D could be read both ways; the others of its file decide, or what the program is known to write.
    """
    votes: dict[bool, str] = {}
    shapes = {image: (held.shapes["keypoints"][0], held.shapes["descriptors"]) for image, held in contents.items()}
    shapes = {image: (count, shape) for image, (count, shape) in shapes.items() if count}
    for image, (count, shape) in shapes.items():
        if len(shape) != 2 or count not in shape:
            raise InputError(
                f"{path}: {shortened(image)}: descriptors: expected [{count}, D] or [D, {count}] as there are "
                f"keypoints, got {list(shape)}"
            )
        if shape[0] != shape[1]:
            votes.setdefault(shape[1] == count, image)
    if len(votes) == 2:
        raise InputError(
            f"{path}: expected descriptors of one layout, got [D, N] for {shortened(votes[True])} and [N, D] for "
            f"{shortened(votes[False])}"
        )
    transposed = next(iter(votes), default)
    dimension = 0
    for image, (_, shape) in shapes.items():
        own = shape[0 if transposed else 1]
        dimension = dimension or own
        if own != dimension:
            raise InputError(f"{path}: {shortened(image)}: descriptors: expected {dimension} numbers each, got {own}")
    return transposed, dimension


def _score_part(parts: Collection[str]) -> str | None:
    return next((part for part in SCORES if part in parts), None)


def _scored(path: Path, contents: Mapping[str, Contents]) -> bool:
    """Whether the images have scores: all or none, as scores of 1 beside others would mean something."""
    without = [image for image, held in contents.items() if _score_part(held.names) is None]
    if without and len(without) < len(contents):
        raise InputError(f"{path}: expected scores of all images or of none, got none of {shortened(without[0])}")
    return not without


def _given_sizes(image_size: Any, count: int) -> np.ndarray:
    """`[M, 2]`."""
    sizes = np.asarray(image_size, np.float32)
    if sizes.shape not in ((2,), (count, 2)) or not (np.isfinite(sizes) & (sizes > 0)).all():
        raise InputError(
            f"image_size: expected (width, height) in pixels, or [{count}, 2] of them, got shape {list(sizes.shape)} "
            "or sizes that are not positive"
        )
    return np.broadcast_to(sizes, (count, 2))


def _image_size(where: str, own: np.ndarray | None, given: np.ndarray | None) -> np.ndarray:
    """`[2]` from the file, or what was given."""
    if own is None:
        if given is None:
            raise InputError(f"{where}: expected image_size, got none; has the file changed since it was opened?")
        return given.copy()
    size = as_float32(f"{where}: image_size", own, "fiu").reshape(-1)
    if size.shape != (2,) or not (size > 0).all():
        raise InputError(f"{where}: image_size: expected (width, height) in pixels, got {own.tolist()}")
    if given is not None and (size != given).any():
        raise InputError(f"{where}: expected the image_size that was given, {given.tolist()}, got {size.tolist()}")
    return size


def _require_inside(where: str, keypoints: np.ndarray, size: np.ndarray) -> None:
    """Refuse keypoints of another image size, or as (y, x): they give wrong scores. float16 may round outwards."""
    margin = np.maximum(2.0, 0.01 * size)
    outside = ((keypoints < -margin) | (keypoints > size - 1 + margin)).any(axis=1)
    if outside.any():
        x, y = keypoints[int(outside.argmax())].tolist()
        raise InputError(
            f"{where}: expected keypoints (x, y) in an image of {size[0]:g} x {size[1]:g} pixels, got ({x:g}, {y:g}); "
            "is image_size (width, height) of the image that they are in?"
        )
