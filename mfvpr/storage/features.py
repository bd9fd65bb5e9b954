"""Local features and global descriptors of images on disk, read by every later run.

    with open_store(store_path(root, "sift", recipe), recipe, num_images=len(keys), keys=keys) as store:
        store.write({row: features})  # batch by batch, the rows that are not done
        for row, features in store.read():
            ...

A row store (`mfvpr.storage.rows`). A row holds `keypoints` float32 `[N, 2]` (px), `descriptors` float16 `[N, D]` of
unit length but for rounding, `scales` float32 `[N]` that restore their lengths, `scores` float32 `[N]` and `image_size`
float32 `[2]` (px). Padding is left out. Features are read as float32: the directions of descriptors change by up to
5e-4, everything else is unchanged. A row of global descriptors holds one `vector` float32 `[D]`, to the bit.
"""

from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.core.types import Features
from mfvpr.storage.manifest import FEATURES, VECTORS, Kind
from mfvpr.storage.rows import RowFormat, RowStore, row_bytes

FeatureStore = RowStore[Features]
_NUM_ARRAYS = 5


def open_store(
    folder: Path, recipe: Mapping[str, Any], *, num_images: int, kind: Kind = FEATURES, **options: Any
) -> FeatureStore:
    """The store in `folder`, see `rows.RowStore`; a map's has a `kind` with other messages."""
    return RowStore(folder, RowFormat(kind, pack_features, _unpack), recipe, {"num_images": num_images}, **options)


def open_vector_store(
    folder: Path, recipe: Mapping[str, Any], *, num_images: int, **options: Any
) -> RowStore[np.ndarray]:
    """The store of global descriptors in `folder`; see `open_store`."""
    form = RowFormat(VECTORS, lambda vector: {"vector": np.asarray(vector, np.float32)}, itemgetter("vector"))
    return RowStore(folder, form, recipe, {"num_images": num_images}, **options)


def forecast_bytes(num_images: int, features_per_image: float, dimension: int) -> int:
    """Bytes on disk, at most, of images with so many features of D = `dimension`."""
    return num_images * row_bytes(features_per_image * (2 * dimension + 16) + 8, _NUM_ARRAYS)


def forecast_vector_bytes(num_images: int, size: int) -> int:
    """Bytes on disk, at most, of one global descriptor of `size` numbers per image."""
    return num_images * row_bytes(4 * size, 1)


def round_as_stored(features: Features) -> Features:
    """Features `[N, ...]` as they come back from a store: without padding, descriptors to 5e-4."""
    return _unpack(pack_features(features))


def pack_features(features: Features) -> dict[str, np.ndarray]:
    mask = np.asarray(features.mask)
    keypoints, descriptors, scores = (
        np.asarray(values, np.float32)[mask] for values in (features.keypoints, features.descriptors, features.scores)
    )
    lengths = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64)).astype(np.float32)
    image_size = np.asarray(features.image_size, np.float32)
    if not all(np.isfinite(part).all() for part in (keypoints, lengths, scores, image_size)):
        raise ValueError("features must be finite")
    directions = (descriptors / np.where(lengths > 0, lengths, 1)[:, None]).astype(np.float16)
    norms = np.sqrt(np.einsum("nd,nd->n", directions, directions, dtype=np.float32))
    return {
        "keypoints": keypoints,
        "descriptors": directions,
        "scales": lengths / np.where(norms > 0, norms, 1),
        "scores": scores,
        "image_size": image_size,
    }


def _unpack(parts: Mapping[str, np.ndarray]) -> Features:
    descriptors = parts["descriptors"].astype(np.float32)
    descriptors *= parts["scales"][:, None]
    return Features(
        keypoints=parts["keypoints"],
        descriptors=descriptors,
        scores=parts["scores"],
        mask=np.ones(len(descriptors), bool),
        image_size=parts["image_size"],
    )
