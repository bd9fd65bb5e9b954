"""Principal components of unit variance, from the covariance or the Gram matrix, whichever is smaller."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Float

from mfvpr.utils.errors import InputError

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
        """Number of components."""
        return len(self.components)


def fit_whitening(sample: Float[np.ndarray, "vectors dimensions"], dimension: int) -> Whitening:
    """Fit a whitening to a finite sample, float32 or float64, in double precision; its arrays have the sample's type.

    As PCA(whiten=True, svd_solver="full") of scikit-learn, with signs that make the entry of the largest magnitude of
    each component (the first of several) positive. Too few or equal vectors raise an `InputError`.
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
