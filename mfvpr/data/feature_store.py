"""Local features of the images of one folder on disk: extracted once, read by every later run.

    with open_store(store_path(root, "street", recipe), recipe, num_images=len(folder)) as store:
        store.write({row: features})  # batch by batch, the rows that are not done
        for row, features in store.read():
            ...

A row store (`mfvpr.data.row_store`) of the arrays `descriptors` float16 `[M, 2**20, D]`, `keypoints` float32
`[M, 2**20, 2]` (px), `scores` float32 `[M, 2**20]` and `image_size` float32 `[M, 2]` (px). A chunk holds 1024 features
of one image; `count` `[M]` are the features of each.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.data import row_store
from mfvpr.data._store_disk import Column, told
from mfvpr.data.row_store import RowStore, open_rows, require_space
from mfvpr.data.store_manifest import FEATURES
from mfvpr.errors import InputError
from mfvpr.types import Features

__all__ = ["FeatureStore", "forecast_bytes", "open_store", "require_space"]

CHUNK_ROWS = 1024  # features; one chunk of descriptors is 1 MB at D = 512
_PER_FEATURE = ("descriptors", "keypoints", "scores")


@dataclass(eq=False)
class FeatureStore:
    """An open store; made by `open_store`."""

    _rows: RowStore = field(repr=False)

    @property
    def folder(self) -> Path:
        """Where it is, absolute."""
        return self._rows.folder

    @property
    def counts(self) -> np.ndarray:
        """`[M]` int32 features of each image, -1 = not done. To be read only."""
        return self._rows.counts

    @property
    def done(self) -> np.ndarray:
        """`[M]` bool, the images whose features are on disk."""
        return self._rows.done

    @property
    def size_bytes(self) -> int:
        """Bytes that the store takes on disk."""
        return self._rows.size_bytes

    def write(self, found: Mapping[int, Features]) -> None:
        """Store the features of a batch of images. When this returns they are done, and on disk.

        Args:
            found: Features `[N, ...]` by row. Padding is left out; descriptors are stored as float16.

        Raises:
            InputError: the disk is full, or cannot be written. Rows done before stay intact.
            ValueError: a row that is done or does not exist, features that are not finite, descriptors longer than 1,
                or of several dimensions.
        """
        if found:
            parts = {row: self._parts(row, features) for row, features in found.items()}
            self._rows.write(parts, _columns(self._dimension(parts.values())))

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """(row, Features `[N, ...]`) of images that are done, by default of all; some are read ahead on threads.

        Descriptors are float32 and of unit length again (float16 moved them by 5e-4 at most), all else is as it was.

        Raises:
            InputError: some were damaged on disk, told after the others were given; they are no longer done, so that
                the next run extracts them anew. Or the disk cannot be read.
            ValueError: a row that is not done.
        """
        for row, parts in self._rows.read(rows):
            yield row, _features(parts)

    def _parts(self, row: int, features: Features) -> dict[str, np.ndarray]:
        """What is stored of an image, by array, without padding."""
        mask = np.asarray(features.mask)
        parts = {name: np.asarray(getattr(features, name), np.float32)[mask] for name in _PER_FEATURE}
        parts["image_size"] = np.asarray(features.image_size, np.float32)
        finite = all(np.isfinite(part).all() for part in parts.values())
        if not finite or np.abs(parts["descriptors"]).max(initial=0) > 1.001:
            raise ValueError(f"{self.folder}: row {row}: features must be finite, and descriptors of unit length")
        return parts

    def _dimension(self, parts: Iterable[Mapping[str, np.ndarray]]) -> int:
        """D of these images and of those before."""
        dimensions = {part["descriptors"].shape[1] for part in parts}
        if self._rows.columns:
            dimensions.update(self._rows.columns["descriptors"].shape)
        if len(dimensions) > 1:
            raise ValueError(f"{self.folder}: descriptors of several dimensions: {sorted(dimensions)}")
        return dimensions.pop()


@contextmanager
def open_store(
    folder: Path, recipe: Mapping[str, Any], *, num_images: int, waiting: Callable[[str], None] | None = None
) -> Iterator[FeatureStore]:
    """The store in `folder`, made if it is not there; no other process can open it meanwhile.

    Args:
        folder: see `store_manifest.store_path`.
        recipe: what the features are made from (JSON values only): weights, settings, images. Kept in plain text.
        num_images: M.
        waiting: is told, in one line, which process this waits for; None = refuse a store that is in use.

    Raises:
        InputError: made from something else, in use, damaged beyond what the next run mends by itself, no store at
            all, or the folder cannot be written.
    """
    with open_rows(folder, FEATURES, recipe, {"num_images": num_images}, waiting) as rows:
        with told(rows.folder, FEATURES.content):
            if (rows.folder / "descriptors" / "zarr.json").exists():
                rows.resume(_columns(_stored_dimension(rows.folder)))
        yield FeatureStore(rows)


def forecast_bytes(num_images: int, features_per_image: float, dimension: int) -> int:
    """Bytes on disk that images with so many features of D = `dimension` take at most."""
    return row_store.forecast_bytes(_columns(dimension), num_images, features_per_image)


def _columns(dimension: int) -> dict[str, Column]:
    return {
        "descriptors": Column("float16", (dimension,), CHUNK_ROWS),
        "keypoints": Column("float32", (2,), CHUNK_ROWS),
        "scores": Column("float32", (), CHUNK_ROWS),
        "image_size": Column("float32", (2,)),
    }


def _stored_dimension(folder: Path) -> int:
    path = folder / "descriptors" / "zarr.json"
    try:
        return int(json.loads(path.read_bytes())["shape"][2])
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{path}: damaged; delete {folder} and run again") from None


def _features(parts: Mapping[str, np.ndarray]) -> Features:
    descriptors = parts["descriptors"].astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)  # zeros stay zeros
    return Features(
        keypoints=parts["keypoints"],
        descriptors=descriptors,
        scores=parts["scores"],
        mask=np.ones(len(descriptors), bool),
        image_size=parts["image_size"],
    )
