"""Images -> features of a whole folder: threads decode while the device works, and a store keeps what is done."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np

from mfvpr.data.datasets import ImageFolder
from mfvpr.data.images import Interpolation, ordered_map, resize
from mfvpr.errors import InputError
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.numerics import available_cpus, round_up
from mfvpr.types import Features, per_keypoint

if TYPE_CHECKING:
    from mfvpr.data.feature_store import FeatureStore

Item = TypeVar("Item")
Track = Callable[[Iterable[Any], int], Iterable[Any]]


def untracked(items: Iterable[Item], total: int) -> Iterable[Item]:
    """No progress bar."""
    return items


@dataclass(frozen=True)
class FeatureSet:
    """Local features of all images of a folder.

    Attributes:
        features: `[M, N, ...]`, padded, NumPy.
        bad: reason by row, for images that are not used: they gave no usable features (their masks are all False), or
            no usable global descriptor.
    """

    features: Features
    bad: Mapping[int, str]

    @classmethod
    def of(cls, images: Sequence[Features]) -> "FeatureSet":
        """Features of your own, image by image `[N_i, ...]`, of as many keypoints as each has; padding is dropped.

        Raises:
            InputError: there are none, their arrays do not fit, or descriptors are not of unit length.
        """
        if not images:
            raise InputError("FeatureSet.of: expected the features of at least one image, got none")
        for number, image in enumerate(images):
            _check(image, number)
        real = [
            replace(image, **{n: np.asarray(v)[np.asarray(image.mask)] for n, v in per_keypoint(image).items()})
            for image in images
        ]
        return cls(_stack(enumerate(real), np.array([len(image.mask) for image in real])), {})

    def __len__(self) -> int:
        return len(self.features.mask)

    def __getitem__(self, row: int) -> Features:
        """Features `[N, ...]` of one image."""
        return jax.tree.map(lambda field: field[row], self.features)


@dataclass(frozen=True)
class Descriptors:
    """Global descriptors of all images of a folder.

    Attributes:
        values: `[M, D]` float32; NaN for bad images, which no shortlist contains.
        bad: reason by row, for images that gave no usable features or descriptor.
    """

    values: np.ndarray
    bad: Mapping[int, str]


def extract(
    folder: ImageFolder,
    extractor: LocalExtractor,
    *,
    store: "FeatureStore | None" = None,
    skip_bad: bool = False,
    track: Track = untracked,
) -> FeatureSet:
    """Local features of every image; decoding runs on threads meanwhile.

    Args:
        folder: the images.
        extractor: what turns images into Features.
        store: of this folder and extractor. Only images that it lacks are read; each batch is on disk before the next
            is begun; and what comes back was read from it, so that a later run gets the same numbers (descriptors as
            float16 keeps them).
        skip_bad: list unreadable images in `bad` and go on, instead of raising. An image whose features are not
            finite is always listed.
        track: progress.

    Raises:
        InputError: an image cannot be read (unless `skip_bad`), or none can; or the store cannot be used.
    """
    found: dict[int, Features] = {}
    bad: dict[int, str] = {}
    missing = range(len(folder)) if store is None else np.flatnonzero(~store.done).tolist()
    for rows, images in _image_batches(folder, missing, extractor, skip_bad, bad, track):
        batch = dict(zip(rows, extractor(images), strict=True))
        for row in [row for row, features in batch.items() if not _finite(features)]:
            del batch[row]
            bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
        if store is None:
            found |= batch
        else:
            store.write(batch)
    if len(bad) == len(folder):
        raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: {bad[min(bad)]}")
    if store is not None:
        return FeatureSet(_stack(store.read(), store.counts), bad)
    counts = np.zeros(len(folder), int)
    counts[list(found)] = [len(features.mask) for features in found.values()]
    return FeatureSet(_stack(found.items(), counts), bad)


def describe(
    folder: ImageFolder,
    feature_set: FeatureSet,
    extractor: GlobalExtractor,
    *,
    store: "FeatureStore | None" = None,
    skip_bad: bool = False,
    track: Track = untracked,
) -> Descriptors:
    """Global descriptors of every image.

    Args:
        folder: the images.
        feature_set: their local features.
        extractor: what describes images, by their pixels or by their local features.
        store: of this folder and extractor, where that reads pixels; as in `extract`.
        skip_bad: go on where an image cannot be read.
        track: progress.

    Raises:
        InputError: as `extract`.
    """
    bad = dict(feature_set.bad)
    if extractor.image_size is None:
        rows = track(range(len(folder)), len(folder))
        batches = (
            extractor(None, [feature_set[row] for row in batch]) for batch in _batches(rows, extractor.batch_size)
        )
        descriptors = np.concatenate(list(batches))
    else:
        whole = extract(folder, _WholeImage(extractor), store=store, skip_bad=skip_bad, track=track)
        bad, descriptors = {**whole.bad, **bad}, whole.features.descriptors[:, 0]
    descriptors[list(bad)] = np.nan
    return Descriptors(descriptors, bad)


@dataclass(frozen=True)
class _WholeImage:
    """A global descriptor as the one feature of its image, so that both kinds are extracted and stored alike."""

    extractor: GlobalExtractor

    @property
    def image_size(self) -> tuple[int, int]:
        if self.extractor.image_size is None:
            raise ValueError(f"{type(self.extractor).__name__} reads no images")
        return self.extractor.image_size

    @property
    def interpolation(self) -> Interpolation:
        return self.extractor.interpolation

    @property
    def batch_size(self) -> int:
        return self.extractor.batch_size

    @property
    def dimension(self) -> int:
        return self.extractor.dimension

    @property
    def typical_count(self) -> int:
        return 1

    def __call__(self, images: np.ndarray) -> list[Features]:
        one, size = np.ones(1, np.float32), np.array(self.image_size, np.float32)
        return [
            Features(size[None] / 2, descriptor[None], one, one.astype(bool), size)
            for descriptor in self.extractor(images, [])
        ]


def _image_batches(
    folder: ImageFolder,
    wanted: Sequence[int],
    extractor: LocalExtractor,
    skip_bad: bool,
    bad: dict[int, str],
    track: Track,
) -> Iterator[tuple[list[int], np.ndarray]]:
    """(rows, images `[B, H, W, 3]`) of the readable ones among `wanted`; the reasons of the others go into `bad`."""
    load = partial(_load, folder, size=extractor.image_size, interpolation=extractor.interpolation)

    def readable() -> Iterator[tuple[int, np.ndarray]]:
        images = ordered_map(load, wanted, workers=available_cpus())
        for row, image in zip(wanted, track(images, len(wanted)), strict=True):
            if isinstance(image, InputError):
                if not skip_bad:
                    raise InputError(f"{image}, or skip bad images")
                bad[row] = str(image)
            else:
                yield row, image

    for batch in _batches(readable(), extractor.batch_size):
        rows, images = zip(*batch, strict=True)
        yield list(rows), np.stack(images)


def _load(
    folder: ImageFolder, row: int, *, size: tuple[int, int], interpolation: Interpolation
) -> np.ndarray | InputError:
    try:
        return resize(folder.read(row), size, interpolation)
    except InputError as error:
        return error


def _batches(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    iterator = iter(items)
    while batch := list(itertools.islice(iterator, size)):
        yield batch


def _check(image: Features, number: int) -> None:
    """Of one's own image `[N, ...]`."""
    count = len(image.mask)
    shapes = {name: np.shape(values) for name, values in per_keypoint(image).items()}
    expected = {
        "keypoints": (count, 2),
        "descriptors": (count, *shapes["descriptors"][1:]),
        "scores": (count,),
        "mask": (count,),
    }
    if shapes != expected or len(shapes["descriptors"]) != 2 or np.asarray(image.mask).dtype != bool:
        raise InputError(
            f"features of image {number}: expected keypoints [N, 2], descriptors [N, D], scores [N] and mask [N] bool, "
            f"got shapes {', '.join(str(shape) for shape in shapes.values())}; transpose descriptors that are [D, N]"
        )
    lengths = np.linalg.norm(np.asarray(image.descriptors, np.float32)[image.mask], axis=1)
    if (wrong := np.abs(lengths - 1) > 0.01).any():
        raise InputError(
            f"features of image {number}: expected descriptors of unit length, got {lengths[wrong][0]:.4g}; "
            "divide them by their Euclidean length"
        )


def _finite(features: Features) -> bool:
    return all(np.isfinite(getattr(features, field.name)).all() for field in fields(features))


def _stack(found: Iterable[tuple[int, Features]], counts: np.ndarray) -> Features:
    """Padded features `[M, N, ...]` of all rows, from (row, Features); rows that are not among them are empty."""
    most = int(counts.max())
    capacity = 1 if most == 1 else round_up(most, 32)  # a global descriptor takes one slot
    arrays: dict[str, np.ndarray] = {}
    for row, features in found:
        if not arrays:
            arrays = {
                name: np.zeros((len(counts), capacity, *values.shape[1:]), values.dtype)
                for name, values in per_keypoint(features).items()
            }
            arrays["image_size"] = np.tile(features.image_size, (len(counts), 1))
        for name, values in per_keypoint(features).items():
            arrays[name][row, : counts[row]] = values
        arrays["image_size"][row] = features.image_size
    return Features(**arrays)
