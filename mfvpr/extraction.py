"""Images -> features of a whole folder: threads decode while the device works, and a store keeps what is done."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from mfvpr.data.datasets import ImageFolder
from mfvpr.data.images import Interpolation, ordered_map, resize
from mfvpr.errors import InputError
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.numerics import available_cpus
from mfvpr.progress import Track, untracked
from mfvpr.sources import FeatureSet, InMemory
from mfvpr.types import Features

if TYPE_CHECKING:
    from mfvpr.stores.features import FeatureStore

Item = TypeVar("Item")


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
            is begun; and what comes back reads from it, so that a later run gets the same numbers (descriptors as
            float16 keeps them).
        skip_bad: list unreadable images in `bad` and go on, instead of raising. An image whose features are not
            finite is always listed.
        track: progress.

    Raises:
        InputError: an image cannot be read (unless `skip_bad`), or none can; or the store cannot be used.
    """
    bad: dict[int, str] = {}
    with nullcontext() if store is None else store:
        images: dict[int, Features] = {}
        missing = range(len(folder)) if store is None else np.flatnonzero(~store.done).tolist()
        for rows, pixels in _image_batches(folder, missing, extractor, skip_bad, bad, track):
            batch = dict(zip(rows, extractor(pixels), strict=True))
            for row in [row for row, features in batch.items() if not _finite(features)]:
                del batch[row]
                bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
            if store is None:
                images |= batch
            else:
                store.write(batch)
    if len(bad) == len(folder):
        raise InputError(f"{folder.root}: none of {len(folder)} images can be used; the first: {bad[min(bad)]}")
    return FeatureSet(InMemory(images, len(folder)) if store is None else store, bad)


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
    descriptors = np.zeros((len(folder), extractor.dimension), np.float32)
    if extractor.image_size is None:
        for batch in _batches(track(range(len(folder)), len(folder)), extractor.batch_size):
            features = dict(feature_set.read(batch))
            if features:
                descriptors[list(features)] = extractor(None, list(features.values()))
    else:
        whole = extract(folder, _WholeImage(extractor), store=store, skip_bad=skip_bad, track=track)
        bad = {**whole.bad, **bad}
        for row, image in whole.read(range(len(folder))):
            descriptors[row] = image.descriptors[0]
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


def _finite(features: Features) -> bool:
    return all(np.isfinite(getattr(features, field.name)).all() for field in fields(features))
