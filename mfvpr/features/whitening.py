"""Principal components of unit variance, of descriptors and of windows of a network's maps.

Whitened windows are the descriptors of both stages of SSM-VPR (Camara & Preucil, RAS 2020). The whitening is learned
from windows of the database's images, see `mfvpr.retrieval.fit_to_database`. It is linear: descriptors of all windows
are one convolution of the map, and only the fitting forms windows.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Float, Int

from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT, FLAG, INDEX, check_fields, setting, whole
from mfvpr.utils.fingerprints import fingerprint, recipe_of

FEW = 10  # Lanczos' method is used if there are this many times more dimensions than components
SMALLEST = 1e-6  # of the largest standard deviation; smaller ones are rounding errors
_BLOCK = 2**25  # numbers in double precision at a time


@dataclass(frozen=True)
class Whitening:
    """Principal components divided by the standard deviations: `(vectors - mean) @ components.T`."""

    mean: Float[np.ndarray, " dimensions"]
    components: Float[np.ndarray, "components dimensions"]  # most variance first; 0 without variance
    origin: str = ""  # fingerprint of the recipe of the only vectors that may be whitened with it; "" = any

    @property
    def dimension(self) -> int:
        return len(self.components)


def fit_whitening(sample: Float[np.ndarray, "vectors dimensions"], dimension: int) -> Whitening:
    """Fit a whitening to a finite sample, float32 or float64, in double precision; its arrays have the sample's type.

    As PCA(whiten=True, svd_solver="full") of scikit-learn, with signs that make the entry of the largest magnitude of
    each component (the first of several) positive. The covariance or the Gram matrix is solved, whichever is smaller.
    Too few or equal vectors raise an `InputError`.
    """
    count, size = sample.shape
    if not 1 <= dimension < count or dimension > size:
        expected = f"more than {dimension} descriptors of as many numbers"
        raise InputError(f"whitening: expected {expected}, got {count} of {size}; keep fewer components")
    mean = sample.mean(axis=0, dtype=np.float64)
    by_rows = size <= count
    products = np.zeros((min(count, size),) * 2)
    for part in _center_blocks(sample, mean, by_rows=by_rows):
        products += part.T @ part if by_rows else part @ part.T
    squares, vectors = _largest(products, dimension)
    if squares[0] <= count * (SMALLEST**2 * 1e-4) * (mean @ mean):
        raise InputError(f"whitening: expected descriptors that differ, got {count} that are alike; use other images")
    if not by_rows:
        vectors = np.concatenate([part.T @ vectors for part in _center_blocks(sample, mean, by_rows=False)])
    has_variance = squares > SMALLEST**2 * squares[0]
    lengths = np.linalg.norm(vectors, axis=0)
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=0)[None], axis=0)[0]
    deviations = np.sqrt(np.where(has_variance, squares, 1) / (count - 1))
    scale = np.where(has_variance, np.sign(largest) / np.where(has_variance, lengths * deviations, 1), 0)
    return Whitening(mean.astype(sample.dtype), (vectors * scale).T.astype(sample.dtype))


def _largest(products: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest eigenvalues `[number]` of a symmetric matrix, descending, and their vectors in columns."""
    order = len(products)
    if FEW * number < order:  # as exact, and much faster
        with suppress(scipy.sparse.linalg.ArpackNoConvergence):
            start = np.random.default_rng(0).normal(size=order)
            squares, vectors = scipy.sparse.linalg.eigsh(products, k=number, which="LA", v0=start)
            descending = np.argsort(-squares)
            return squares[descending], vectors[:, descending]
    interval = (order - number, order - 1)
    squares, vectors = scipy.linalg.eigh(products, subset_by_index=interval, overwrite_a=True, check_finite=False)
    return squares[::-1], vectors[:, ::-1]


def _center_blocks(sample: np.ndarray, mean: np.ndarray, *, by_rows: bool) -> Iterator[np.ndarray]:
    """The sample minus its mean in double precision, in blocks of rows or of columns."""
    count, size = sample.shape
    step = max(1, _BLOCK // (size if by_rows else count))
    for start in range(0, count if by_rows else size, step):
        part = slice(start, start + step)
        yield sample[part] - mean if by_rows else sample[:, part] - mean[part]


@dataclass(frozen=True)
class Windows:
    """Positions of the windows of a map, in row order."""

    shape: tuple[int, int, int]  # (rows, columns, channels) of the map
    size: int  # positions per side of a window
    stride: int = 1  # positions from window to window

    def __post_init__(self) -> None:
        if min(self.shape[:2]) < self.size:
            got = f"{self.shape[0]} x {self.shape[1]}; take larger images"
            raise InputError(f"windows of {self.size} x {self.size}: expected a map of as many positions, got {got}")

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of windows."""
        rows, columns = ((side - self.size) // self.stride + 1 for side in self.shape[:2])
        return rows, columns

    @property
    def count(self) -> int:
        return self.grid[0] * self.grid[1]

    @property
    def dimension(self) -> int:
        """Length of a window as a vector, (row, column, channel)."""
        return self.size**2 * self.shape[2]

    @property
    def corners(self) -> Int[np.ndarray, "windows 2"]:
        """(row, column) of each window's first position."""
        return self.stride * np.stack(np.divmod(np.arange(self.count), self.grid[1]), axis=1)

    def take(self, image_map: np.ndarray, numbers: Int[np.ndarray, " windows"]) -> Float[np.ndarray, "windows _"]:
        """The windows `numbers` of one map `[rows, columns, channels]`."""
        parts = [image_map[row : row + self.size, column : column + self.size] for row, column in self.corners[numbers]]
        return np.reshape(parts, (len(numbers), self.dimension))


@dataclass(frozen=True)
class WindowFitting:
    """Settings of a whitening that is learned from random windows of random images of the database.

    `dimension` is D' of the whitened vectors, `dtype` that of the windows and of the result (sums are always in double
    precision). The public code has no seed; its second stage has a `zero_row`, a window of zeros.
    """

    dimension: int = setting(100, whole(1, 4096), "that are learned from the database and kept")
    max_images: int | None = setting(250, COUNT | None, "of the database to learn from; null = all")
    max_windows: int | None = setting(10_000, COUNT | None, "of these images; null = all")
    zero_row: bool = setting(False, FLAG, "learn from a row of zeros as well, as the public code may")
    dtype: Literal["float32", "float64"] = "float32"
    seed: int = setting(0, INDEX)

    __post_init__ = check_fields

    def sample_rows(self, num_images: int) -> list[int]:
        """Rows of the images to learn from."""
        rows = np.random.default_rng([self.seed, 0]).permutation(num_images)
        return sorted(rows[: self.max_images].tolist())

    def fit(
        self,
        maps: Iterable[Mapping[int, Float[np.ndarray, "rows columns channels"]]],
        windows: Windows,
        rows: list[int],
    ) -> Whitening:
        """Learn the whitening from maps of the images in `rows` (`sample_rows`), which come by row in batches.

        Unreadable images may be missing. Too few windows raise an `InputError`.
        """
        chosen = np.arange(len(rows) * windows.count)
        if self.max_windows is not None and len(chosen) > self.max_windows:
            rng = np.random.default_rng([self.seed, 1])
            chosen = np.sort(rng.choice(len(chosen), self.max_windows, replace=False))
        place, number = np.divmod(chosen, windows.count)
        sample, filled = np.zeros((len(chosen) + self.zero_row, windows.dimension), self.dtype), 0
        for row, image_map in itertools.chain.from_iterable(batch.items() for batch in maps):
            numbers = number[place == rows.index(row)]
            sample[filled : filled + len(numbers)] = windows.take(image_map, numbers)
            filled += len(numbers)
        return fit_whitening(sample[: filled + self.zero_row], self.dimension)


def learned_whitening(extractor: Any) -> Whitening:
    """Learned whitening of an extractor; an `InputError` if it was not learned yet, or from something else."""
    name, whitening, expected = type(extractor).__name__, extractor.whitening, extractor.windows.dimension
    if not isinstance(whitening, Whitening):
        raise InputError(f"{name}: expected a learned whitening, got settings; call mfvpr.retrieval.fit_to_database")
    if len(whitening.mean) != expected or whitening.origin not in ("", origin(extractor)):
        got = f"one of {len(whitening.mean)} that was learned with others; replace it by a WindowFitting"
        same = f"{expected} numbers that was learned with the same network, images and windows"
        raise InputError(f"{name}: expected a whitening of {same}, got {got}")
    return whitening


def origin(extractor: Any) -> str:
    """Hash of the network, its preprocessing and the windows; "" if they have no recipe."""
    with suppress(TypeError):
        return fingerprint(recipe_of([extractor.maps, extractor.windows]))
    return ""


def kernels(whitening: Whitening, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """The whitening as a convolution of a map: a kernel `[size, size, channels, D']` and an offset `[D']`, float32."""
    components = whitening.components.reshape(-1, windows.size, windows.size, windows.shape[2])
    offset = whitening.components.astype(np.float64) @ whitening.mean
    return np.moveaxis(components, 0, -1).astype(np.float32), offset.astype(np.float32)
