"""Local features of the images of one folder on disk: extracted once, read by every later run.

    with open_store(store_path(root, "street", recipe), recipe, num_images=len(folder)) as store:
        store.write({row: features})  # batch by batch, the rows that are not done
        for row, features in store.read():
            ...

A store is a Zarr v3 group of the arrays `descriptors` float16 `[M, 2**20, D]`, `keypoints` float32 `[M, 2**20, 2]`
(px), `scores` float32 `[M, 2**20]`, `image_size` float32 `[M, 2]` (px) and `count` int32 `[M]`. A chunk holds 1024
features of one image, compressed and with a checksum; what an image does not fill costs nothing.

`count` is -1, without a chunk, until all else of an image is on disk: one small file, which appears as a whole, says
that the image is done. So a process may be killed at any moment, and the next one goes on.
"""

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tensorstore as ts

from mfvpr.data._store_disk import (
    CHUNK_ROWS,
    commit,
    free_bytes,
    is_damage,
    locked,
    open_arrays,
    read_counts,
    reason,
    stored_dimension,
    told,
    too_full,
)
from mfvpr.data.store_manifest import check_owned, settle_manifest
from mfvpr.errors import InputError
from mfvpr.types import Features

READ_AHEAD = 16  # images
BLOCK = 4096  # bytes that a file system hands out at a time
_PER_FEATURE = ("descriptors", "keypoints", "scores")


@dataclass(eq=False)
class FeatureStore:
    """An open store; made by `open_store`.

    Attributes:
        folder: where it is, absolute.
        counts: `[M]` int32 features of each image, -1 = not done. To be read only.
    """

    folder: Path
    counts: np.ndarray
    _context: ts.Context = field(repr=False)
    _arrays: dict[str, ts.TensorStore] = field(repr=False)  # empty until the first image tells D

    @property
    def done(self) -> np.ndarray:
        """`[M]` bool, the images whose features are on disk."""
        return self.counts >= 0

    @property
    def size_bytes(self) -> int:
        """Bytes that the store takes on disk."""
        return sum(path.stat().st_blocks * 512 for path in self.folder.rglob("*"))

    def write(self, found: Mapping[int, Features]) -> None:
        """Store the features of a batch of images. When this returns they are done, and on disk.

        Args:
            found: Features `[N, ...]` by row. Padding is left out; descriptors are stored as float16.

        Raises:
            InputError: the disk is full, or cannot be written. Rows done before stay intact.
            ValueError: a row that is done or does not exist, features that are not finite, descriptors longer than 1,
                or of several dimensions.
        """
        if not found:
            return
        parts = {row: self._parts(row, features) for row, features in found.items()}
        dimension = self._dimension(parts.values())
        counts = {row: len(part["scores"]) for row, part in parts.items()}
        needed = forecast_bytes(int((~self.done).sum()), sum(counts.values()) / len(counts), dimension)
        with told(self.folder, needed):
            if not self._arrays:
                self._arrays.update(open_arrays(self.folder, len(self.counts), dimension, self._context))
            commit([self._write_part(row, name, part[name]) for row, part in parts.items() for name in part])
            commit([self._arrays["count"][row].write(count) for row, count in counts.items()])
        self.counts[list(counts)] = list(counts.values())

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """(row, Features `[N, ...]`) of images that are done, by default of all; some are read ahead on threads.

        Descriptors are float32 and of unit length again (float16 moved them by 5e-4 at most), all else is as it was.

        Raises:
            InputError: some were damaged on disk, told after the others were given; they are no longer done, so that
                the next run extracts them anew. Or the disk cannot be read.
            ValueError: a row that is not done.
        """
        rows = np.flatnonzero(self.done).tolist() if rows is None else list(rows)
        if missing := [row for row in rows if self.counts[row] < 0]:
            raise ValueError(f"{self.folder}: row {missing[0]} is not done")
        damaged: dict[int, str] = {}
        requests = ((row, self._request(row)) for row in rows)
        waiting = deque(itertools.islice(requests, READ_AHEAD))
        while waiting:
            row, futures = waiting.popleft()
            waiting.extend(itertools.islice(requests, 1))
            with told(self.folder):
                try:
                    parts = {name: future.result() for name, future in futures.items()}
                except ValueError as error:
                    if not is_damage(error):
                        raise
                    damaged[row] = reason(error)
                    continue
            yield row, _features(parts)
        if damaged:
            self._report(damaged)

    def _parts(self, row: int, features: Features) -> dict[str, np.ndarray]:
        """What is stored of an image, by array, without padding."""
        if not 0 <= row < len(self.counts) or self.counts[row] >= 0:
            raise ValueError(f"{self.folder}: row {row} is done or does not exist")
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
        if self._arrays:
            dimensions.add(self._arrays["descriptors"].shape[2])
        if len(dimensions) > 1:
            raise ValueError(f"{self.folder}: descriptors of several dimensions: {sorted(dimensions)}")
        return dimensions.pop()

    def _write_part(self, row: int, name: str, part: np.ndarray) -> ts.WriteFutures:
        """Whole chunks: nothing is read before, so whatever an interrupted run left does not matter."""
        array = self._arrays[name]
        if name not in _PER_FEATURE:
            return array[row].write(part)
        length = -(-len(part) // CHUNK_ROWS) * CHUNK_ROWS
        padded = np.full((length, *part.shape[1:]), np.nan, array.dtype.numpy_dtype)
        padded[: len(part)] = part
        return array[row, :length].write(padded)

    def _request(self, row: int) -> dict[str, ts.Future]:
        futures = {name: self._arrays[name][row, : int(self.counts[row])].read() for name in _PER_FEATURE}
        return {**futures, "image_size": self._arrays["image_size"][row].read()}

    def _report(self, damaged: Mapping[int, str]) -> NoReturn:
        with told(self.folder):
            commit([self._arrays["count"][row].write(-1) for row in damaged])
        self.counts[list(damaged)] = -1
        row, what = next(iter(damaged.items()))
        raise InputError(
            f"{self.folder}: features of {len(damaged)} images are damaged on disk, the first in row {row} ({what}); "
            "run again, which extracts them anew"
        )


@contextmanager
def open_store(folder: Path, recipe: Mapping[str, Any], *, num_images: int) -> Iterator[FeatureStore]:
    """The store in `folder`, made if it is not there; no other process can open it meanwhile.

    Args:
        folder: see `store_manifest.store_path`.
        recipe: what the features are made from (JSON values only): weights, settings, images. Kept in plain text.
        num_images: M.

    Raises:
        InputError: made from something else, in use, damaged beyond what the next run mends by itself, no store at
            all, or the folder cannot be written.
    """
    folder = folder.absolute()  # the working directory may change
    with told(folder):
        str(folder).encode()  # tensorstore takes no path that is not Unicode
        check_owned(folder)
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        with told(folder):
            settle_manifest(folder, recipe, num_images)
            context = ts.Context({"file_io_sync": True})  # one for all arrays
            arrays: dict[str, ts.TensorStore] = {}
            counts = np.full(num_images, -1, np.int32)
            if (folder / "descriptors" / "zarr.json").exists():
                arrays = open_arrays(folder, num_images, stored_dimension(folder), context)
                counts = read_counts(arrays["count"])
        yield FeatureStore(folder, counts, context, arrays)


def forecast_bytes(num_images: int, features_per_image: float, dimension: int) -> int:
    """Bytes on disk that images with so many features of D = `dimension` take at most."""
    files = [2 * dimension * features_per_image, 8 * features_per_image, 4 * features_per_image, 8, 4]
    return num_images * sum(int(-(-size // BLOCK)) * BLOCK for size in files)


def require_space(folder: Path, num_bytes: int) -> None:
    """Refuse to start what will not fit.

    Raises:
        InputError: less than `num_bytes` are free where `folder` is, or will be.
    """
    free = free_bytes(folder)
    if free < num_bytes:
        raise InputError(too_full(folder, num_bytes, free))


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
