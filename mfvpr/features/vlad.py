"""VLAD of local features (Jegou et al., CVPR 2010): a filter without a download.

Residuals to the nearest visual word are summed per word, each sum is normalized by itself (intra-normalization,
Arandjelovic & Zisserman, CVPR 2013), then signed square root (power law) and unit length.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from mfvpr.features.feature_set import FeatureSet
from mfvpr.types import Features
from mfvpr.utils.errors import InputError

# Chosen so that R@1 hardly depends on the input's last bits, with SIFT and with ALIKED, summer against snow.
_VARIANCE = 0.015  # of a word's Gaussian, in squared lengths of descriptors
_START = 0.5  # of the descriptors' spread
_ITERATIONS = 10
_CHUNK = 2**23  # numbers of an array at a time: few large products, which do not fight over threads


@dataclass(frozen=True)
class VladFitting:
    """How a vocabulary is learned: the centers of a mixture of round Gaussians of equal size, by a few steps of EM.

    That is k-means whose memberships are soft, so that it is smooth in the descriptors. k-means itself is not: a last
    bit, or one keypoint more, moves a descriptor to another word, and every step multiplies the difference.

    Attributes:
        num_words: M.
        power: exponent of the power law.
        max_samples: descriptors to learn from, at most.
        seed: of the images that are drawn, and of the start: a normal draw with the descriptors' mean and covariance.

    Raises:
        InputError: `max_samples` are fewer than `num_words`.
    """

    num_words: int = 64
    power: float = 0.5
    max_samples: int = 100_000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_samples < self.num_words:
            raise InputError(f"max_samples={self.max_samples}: expected at least one for each of "
                             f"num_words={self.num_words} words")  # fmt: skip

    def fit(self, database: FeatureSet) -> "Vlad":
        """The vocabulary of the database, of which some images are drawn where all have more than `max_samples`.

        Raises:
            InputError: the database has fewer descriptors than there are words.
        """
        counts = database.counts
        if counts.sum() < self.num_words:
            raise InputError(
                f"{counts.sum()} local features in {len(database)} database images: expected at least one for each of "
                f"the {self.num_words} words; check the images and what finds their features, or lower num_words"
            )
        rng = np.random.default_rng(self.seed)
        drawn = rng.permutation(len(database))  # whole images: a feature more in one of them changes no other's part
        enough = 1 + np.searchsorted(np.cumsum(counts[drawn]), self.max_samples)
        real = [image.descriptors for _, image in database.read(drawn[:enough].tolist())]
        centers = _mixture(np.concatenate(real)[: self.max_samples], self.num_words, rng)
        return Vlad(centers.astype(np.float32), self.power)


@dataclass(frozen=True)
class Vlad:
    """A vocabulary of M visual words `centers` `[M, D]`, and the power law's exponent."""

    centers: np.ndarray  # [M, D]
    power: float = 0.5

    @property
    def vector_size(self) -> int:
        """Words x dimension of the local descriptors."""
        return self.centers.size

    def __call__(self, images: Sequence[Features]) -> np.ndarray:
        """`[B, M * D]` float32 descriptors of unit length; zero where an image has no features."""
        # All images at once, for the same reason.
        real = [features.descriptors[features.mask] for features in images]
        descriptors = np.concatenate(real)
        if descriptors.shape[1] != self.centers.shape[1]:
            raise InputError(f"VLAD: expected descriptors of {self.centers.shape[1]} dimensions, as those that it was "
                             f"fitted on, got {descriptors.shape[1]}")  # fmt: skip
        word = _nearest(descriptors, self.centers)
        cell = np.repeat(np.arange(len(real)) * len(self.centers), list(map(len, real))) + word
        order = np.argsort(cell, kind="stable")
        occupied, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
        residuals = np.zeros((len(real) * len(self.centers), self.centers.shape[1]), np.float32)
        if len(order):
            sums = np.add.reduceat(descriptors[order], starts)
            residuals[occupied] = sums - counts[:, None] * self.centers[occupied % len(self.centers)]
        vlad = _normalized(residuals)
        vlad = np.sign(vlad) * np.abs(vlad) ** self.power
        return _normalized(vlad.reshape(len(real), self.vector_size))


def _mixture(sample: np.ndarray, num_words: int, rng: np.random.Generator) -> np.ndarray:
    """`[M, D]` float64 centers of Gaussians; one that nobody belongs to stays."""
    mean, dimension = sample.mean(axis=0, dtype=np.float64), sample.shape[1]
    covariance = sum((part - mean).T @ (part - mean) for part in _parts(sample, num_words)) / len(sample)
    spread = np.linalg.cholesky(covariance + 1e-9 * np.eye(dimension))
    centers = mean + _START * rng.standard_normal((num_words, dimension)) @ spread.T
    for _ in range(_ITERATIONS):
        members, sums = np.zeros((num_words, 1)), np.zeros_like(centers)
        for part in _parts(sample, num_words):
            shares = softmax(-_distances(part, centers) / (2 * _VARIANCE), axis=1)
            members += shares.sum(axis=0)[:, None]
            sums += shares.T @ part
        centers = np.where(members > 0, sums / np.where(members > 0, members, 1), centers)
    return centers


def _parts(sample: np.ndarray, num_words: int) -> Iterator[np.ndarray]:
    """Some rows at a time, float64."""
    rows = max(1, _CHUNK // max(num_words, sample.shape[1]))
    return (sample[start : start + rows].astype(np.float64) for start in range(0, len(sample), rows))


def _nearest(descriptors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """`[n]` index of the nearest center, the first on a tie."""
    # No matrix product: its threads stay awake for a while and take the cores from whoever matches the image next.
    products = np.vecdot(descriptors[:, None], centers)
    return np.argmin((centers**2).sum(1) - 2 * products, axis=1)


def _distances(descriptors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """`[n, M]` squared distances, but for what is the same for all centers."""
    return (centers**2).sum(1) - 2 * descriptors @ centers.T


def _normalized(vectors: np.ndarray) -> np.ndarray:
    """Unit length along the last axis; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
