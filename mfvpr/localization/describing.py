"""Images -> local features and a global descriptor, the same for images of the map and for queries."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard

import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import read_image, resize
from mfvpr.features.extractor import Aggregation, Description, Extractor
from mfvpr.features.feature_extraction import describe_folder, describe_images
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.storage.packing import round_as_stored
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_array
from mfvpr.utils.progress import Track, no_progress

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
        return self.resized(self.resize(load(image)), str(image) if is_file(image) else "image")

    def resize(self, pixels: Pixels) -> list[Pixels]:
        """Resize an image for each extractor."""
        return [resize(pixels, extractor.image_size, extractor.interpolation) for extractor in self._extractors]

    def resized(self, images: Sequence[Pixels], name: str) -> Described:
        """Describe one image, from what `resize` made of it; `name` stands in errors."""
        descriptions = [_extract(*pair, name) for pair in zip(self._extractors, images, strict=True)]
        features = round_as_stored(descriptions[0].features)
        [vector] = self._vectors([features], descriptions[-1:])
        return features, vector

    def folder(
        self, images: ImageFolder, rows: Sequence[int], track: Track = no_progress
    ) -> Iterator[dict[int, Described]]:
        """Describe some images of a folder: batches of descriptions by row."""
        for batch in _batches(images, self.extractor, rows, track):
            features = [round_as_stored(description.features) for description in batch.values()]
            descriptions = [*batch.values()]
            for describer in self._extractors[1:]:
                parts = _batches(images, describer, [*batch], no_progress)
                descriptions = [description for part in parts for description in part.values()]
            vectors = self._vectors(features, descriptions)
            yield dict(zip(batch, zip(features, vectors, strict=True), strict=True))

    def cached(self, images: ImageFolder, rows: Sequence[int], cache: FeatureCache) -> Iterator[dict[int, Described]]:
        """Describe images by way of a cache, which extracts what it lacks; it may skip bad ones."""
        [features] = cache.local(images, self.extractor, rows)
        describer = self.describer if isinstance(self.describer, Extractor) else None
        vectors = None if describer is None else cache.vectors(images, describer, images, rows)
        bad, size = {**features.bad, **(vectors.bad if vectors else {})}, self.extractor.batch_size
        for reason in bad.values():
            cache.warn(reason)
        used = [row for row in rows if row not in bad]
        for start in range(0, len(used), size):
            batch = dict(features.read(used[start : start + size]))
            if cache.root is None:
                batch = {row: round_as_stored(local) for row, local in batch.items()}
            values = self._vectors([*batch.values()], []) if vectors is None else vectors.values[[*batch]]
            yield dict(zip(batch, zip(batch.values(), values, strict=True), strict=True))

    @property
    def _extractors(self) -> list[Extractor]:
        """The extractor, and the describer if it is another extractor."""
        if isinstance(describer := self.describer, Extractor) and describer is not self.extractor:
            return [self.extractor, describer]
        return [self.extractor]

    def _vectors(self, features: Sequence[Features], descriptions: Sequence[Description]) -> Sequence[np.ndarray]:
        """Global descriptors of images: aggregated features, or those in the descriptions."""
        if isinstance(describer := self.describer, Extractor):
            return [_flat(description) for description in descriptions]
        return [*describer(features)]


def is_file(image: Image) -> TypeGuard[Path | str]:
    """Whether an image is a path."""
    return isinstance(image, str | os.PathLike)


def load(image: Image) -> Pixels:
    """Read an image file, or convert an array; an InputError if it is no image."""
    if is_file(image):
        return read_image(image)
    try:
        pixels = np.asarray(as_array(image))
    except Exception as error:  # other libraries raise any error, torch for tensors with gradients
        reason = " ".join(str(error).split())
        raise InputError(f"image: expected a file or [H, W, 3] uint8 RGB, got {type(image).__name__} ({reason}). "
                         "Convert it to a NumPy array.") from None  # fmt: skip
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        got = f"{list(pixels.shape)} {pixels.dtype}" if pixels.shape else type(image).__name__
        raise InputError(f"image: expected a file or [H, W, 3] uint8 RGB, got {got}. Check that the camera gave an "
                         "image.")  # fmt: skip
    return pixels


def _extract(extractor: Extractor, image: Pixels, name: str) -> Description:
    [description] = describe_images(image[None], extractor)
    if description is None:
        raise InputError(f"{name}: features are not finite (NaN or infinite)")
    return description


def _batches(
    images: ImageFolder, extractor: Extractor, rows: Sequence[int], track: Track
) -> Iterator[dict[int, Description]]:
    """Batches of descriptions by row; an image that is not finite raises an InputError, too."""
    bad: dict[int, str] = {}
    for batch in describe_folder(images, extractor, rows, bad, track=track):
        if bad:
            raise InputError(next(iter(bad.values())))
        yield batch


def _flat(description: Description) -> np.ndarray:
    if description.vector is None:
        raise InputError("describer: gives no global descriptor; expected one that does, or VladFitting()")
    return np.asarray(description.vector, np.float32).reshape(-1)
