"""Extract descriptions of a folder's images: threads decode while the device works."""

import itertools
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Num

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import Interpolation, resize
from mfvpr.features.extractor import Description, Extractor
from mfvpr.features.feature_set import check_features, without_padding
from mfvpr.utils.errors import InputError, require_word
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.runtime import Track, no_progress, ordered_map


def describe_folder(
    folder: ImageFolder,
    extractor: Extractor,
    rows: Sequence[int],
    bad: dict[int, str],
    *,
    skip_bad: bool = False,
    track: Track = no_progress,
) -> Iterator[dict[int, Description]]:
    """Extract descriptions of the images in `rows`, by row, batch by batch.

    Images that are not used are added to `bad`, row -> reason: images whose description is not finite, and with
    `skip_bad` images that cannot be read. Without `skip_bad` these raise an `InputError`.
    """
    if extractor.batch_size < 1:
        raise InputError(f"batch_size={extractor.batch_size}: expected a whole number above 0")
    images = _readable_images(folder, rows, extractor, skip_bad, bad, track)
    while batch := list(itertools.islice(images, extractor.batch_size)):
        batch_rows, arrays = zip(*batch, strict=True)
        descriptions = {}
        for row, description in zip(batch_rows, describe_images(np.stack(arrays), extractor), strict=True):
            if description is None:
                bad[row] = f"{folder.paths[row]}: features are not finite (NaN or infinite); the image ranks last"
            else:
                descriptions[row] = description
        yield descriptions


def describe_images(images: Num[np.ndarray, "images height width 3"], extractor: Extractor) -> list[Description | None]:
    """Extract descriptions of images of the extractor's size; None if a description is not finite."""
    descriptions = list(extractor(images))
    _check_descriptions(descriptions, extractor, len(images))
    unpadded = (Description(vector, tuple(map(without_padding, local))) for vector, local in descriptions)
    return [
        description if all(np.isfinite(array).all() for array in jax.tree.leaves(description)) else None
        for description in unpadded
    ]


def _check_descriptions(descriptions: list[Description], extractor: Extractor, num_images: int) -> None:
    name, expected = type(extractor).__name__, [scale.dimension for scale in extractor.scales]
    if len(descriptions) != num_images:
        raise InputError(f"{name}: expected a Description of each of {num_images} images, got {len(descriptions)}")
    for description in descriptions:
        if not isinstance(description, Description):
            got = type(description).__name__
            raise InputError(f"{name}: expected a Description, got {got}; return Description(vector, (features,))")
        vector, local = description
        for features in local:
            check_features(features, f"{name}: features", unit_length=False)
        if (got := [features.descriptors.shape[-1] for features in local]) != expected:
            raise InputError(f"{name}: expected local features of {expected} dimensions, as its scales say, got {got}")
        if (size := 0 if vector is None else np.size(vector)) != extractor.vector_size:
            raise InputError(f"{name}: vector_size={extractor.vector_size}, but a description with {size} numbers")


def _readable_images(
    folder: ImageFolder,
    rows: Sequence[int],
    extractor: Extractor,
    skip_bad: bool,
    bad: dict[int, str],
    track: Track,
) -> Iterator[tuple[int, Num[np.ndarray, "height width 3"]]]:
    """(row, image) of readable images; the reasons of the others are added to `bad`."""

    def load(row: int) -> np.ndarray | InputError:
        try:
            return resize(folder.read(row), extractor.image_size, extractor.interpolation)
        except InputError as error:
            return error

    require_word("interpolation", extractor.interpolation, Interpolation)  # `load` would take it for a bad image
    images = ordered_map(load, rows, workers=available_cpus())
    for row, image in zip(rows, track(images, len(rows)), strict=True):
        if not isinstance(image, InputError):
            yield row, image
        elif skip_bad:
            bad[row] = str(image)
        else:
            raise InputError(f"{image}, or skip bad images")
