"""Images -> local features and a global descriptor, the same for images of the map and for queries."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.features.extractor import Aggregation, Description, Extractor, describe_images
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.packing import round_as_stored
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array

Image = Path | str | ArrayLike
Described = tuple[Features, np.ndarray]
Pixels = UInt8[np.ndarray, "_ _ 3"]


@dataclass(frozen=True)
class Describing:
    """Extractors of a map; the features of queries are rounded as a store rounds the features of the map."""

    extractor: Extractor  # of local features of one scale
    describer: Extractor | Aggregation  # of global descriptors; may be the same extractor

    def image(self, image: Image) -> Described:
        """Describe one image: a file, or `[H, W, 3]` uint8 RGB in any form that `np.asarray` converts."""
        return self.pixels(load(image), str(image) if is_file(image) else "image")[0]

    def pixels(self, pixels: Pixels, name: str) -> tuple[Described, Pixels]:
        """Describe one image; also return it at the size of the extractor. `name` stands in errors."""
        image, description = _extract(self.extractor, pixels, name)
        features = round_as_stored(description.features)
        if not isinstance(self.describer, Extractor):
            [vector] = self.describer([features])
            return (features, vector), image
        if self.describer is not self.extractor:
            _, description = _extract(self.describer, pixels, name)
        if description.vector is None:
            raise InputError("describer: gives no global descriptor; expected one that does, or VladFitting()")
        return (features, np.asarray(description.vector, np.float32).reshape(-1)), image

    def folder(self, images: ImageFolder, cache: FeatureCache) -> Iterator[dict[int, Described]]:
        """Describe the images of a folder that a cache lacks: batches by row. The cache may skip bad images."""
        [features] = cache.local(images, self.extractor)
        vectors = cache.vectors(images, self.describer, images) if isinstance(self.describer, Extractor) else None
        aggregate: Any = self.describer
        bad, size = {**features.bad, **(vectors.bad if vectors else {})}, self.extractor.batch_size
        if bad and not cache.skip_bad:
            raise InputError(bad[min(bad)])
        for reason in bad.values():
            cache.warn(reason)
        used = [row for row in range(len(images)) if row not in bad]
        for start in range(0, len(used), size):
            batch = dict(features.source.read(used[start : start + size]))  # also those without keypoints
            if cache.root is None:
                batch = {row: round_as_stored(local) for row, local in batch.items()}
            values = vectors.values[[*batch]] if vectors else aggregate([*batch.values()])
            yield dict(zip(batch, zip(batch.values(), values, strict=True), strict=True))


def is_file(image: Image) -> TypeGuard[Path | str]:
    """Whether an image is a path."""
    return isinstance(image, str | os.PathLike)


def load(image: Image) -> Pixels:
    """Read an image file, or convert an array; an InputError if it is no image."""
    if is_file(image):
        return read_image(image)
    expected = "image: expected a file or [H, W, 3] uint8 RGB, got"
    try:
        pixels = np.asarray(as_array(image))
    except Exception as error:  # other libraries raise any error, torch for tensors with gradients
        got = f"{type(image).__name__} ({' '.join(str(error).split())})"
        raise InputError(f"{expected} {got}. Convert it to a NumPy array.") from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        got = f"{list(pixels.shape)} {pixels.dtype}" if pixels.shape else type(image).__name__
        raise InputError(f"{expected} {got}. Check that the camera gave an image.")
    return pixels


def _extract(extractor: Extractor, pixels: Pixels, name: str) -> tuple[Pixels, Description]:
    """An image at the size of an extractor, and its description."""
    image = resize(pixels, extractor.image_size, extractor.interpolation)
    [description] = describe_images(image[None], extractor)
    if description is None:
        raise InputError(f"{name}: features are not finite (NaN or infinite)")
    return image, description
