"""Images -> descriptions of a whole folder: threads decode while the device works."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from functools import partial
from typing import TypeVar

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.images import Interpolation, resize
from mfvpr.features.extractor import Description, Extractor
from mfvpr.features.feature_set import check_features, without_padding
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.progress import Track, untracked
from mfvpr.utils.threads import ordered_map

Item = TypeVar("Item")


def described(
    folder: ImageFolder,
    extractor: Extractor,
    rows: Sequence[int],
    bad: dict[int, str],
    *,
    skip_bad: bool = False,
    track: Track = untracked,
) -> Iterator[dict[int, Description]]:
    """Descriptions of some images by row, batch by batch.

    Args:
        folder: the images.
        extractor: what turns images into descriptions.
        rows: which.
        bad: gets the reason, by row, of images that are not used: those that cannot be read, if they are skipped, and
            those whose description is not finite.
        skip_bad: go on where an image cannot be read, instead of raising.
        track: progress.

    Raises:
        InputError: an image cannot be read (unless `skip_bad`).
    """
    for part, images in _image_batches(folder, rows, extractor, skip_bad, bad, track):
        found = dict(zip(part, described_images(images, extractor), strict=True))
        for row in (row for row, description in found.items() if description is None):
            bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
        yield {row: description for row, description in found.items() if description is not None}


def described_images(images: np.ndarray, extractor: Extractor) -> list[Description | None]:
    """Descriptions of images `[B, H, W, 3]` of the extractor's size; None of one that is not finite.

    Raises:
        InputError: the extractor gives something else than it says.
    """
    found = _checked(list(extractor(images)), extractor, len(images))
    return [description if _finite(description) else None for description in found]


def _checked(descriptions: list[Description], extractor: Extractor, number: int) -> list[Description]:
    """What an extractor of somebody's own gives.

    Raises:
        InputError: not what it says.
    """
    who, scales = type(extractor).__name__, extractor.scales
    if len(descriptions) != number:
        raise InputError(f"{who}: expected a Description of each of {number} images, got {len(descriptions)}")
    for one in descriptions:
        if not isinstance(one, Description):
            raise InputError(f"{who}: expected a Description, got {type(one).__name__}; return "
                             "Description(vector, (features,))")  # fmt: skip
        for local in one.local:
            check_features(local, f"{who}: features", unit_length=False)
        sizes = [local.descriptors.shape[-1] for local in one.local]
        if sizes != (expected := [scale.dimension for scale in scales]):
            raise InputError(f"{who}: expected local features of {expected} dimensions, as its scales say, got {sizes}")
        if (size := 0 if one.vector is None else np.size(one.vector)) != extractor.vector_size:
            raise InputError(f"{who}: vector_size={extractor.vector_size}, but a description with {size} numbers")
    return [Description(one.vector, tuple(map(without_padding, one.local))) for one in descriptions]


def _image_batches(
    folder: ImageFolder,
    wanted: Sequence[int],
    extractor: Extractor,
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


def _finite(description: Description) -> bool:
    arrays = [getattr(local, part.name) for local in description.local for part in fields(local)]
    arrays += [] if description.vector is None else [description.vector]
    return all(np.isfinite(array).all() for array in arrays)
