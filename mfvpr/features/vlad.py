"""VLAD of local features (Jegou et al., CVPR 2010): retrieval without a download.

Residuals to the nearest visual word are summed per word, each sum is normalized by itself (intra-normalization,
Arandjelovic & Zisserman, CVPR 2013), then signed square root (power law) and unit length.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its subpackages are imported at their first use
from jaxtyping import Float

from mfvpr.core.types import Features
from mfvpr.features.feature_set import FeatureSet
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import COUNT, INDEX, POSITIVE, check_fields, setting, whole

# Chosen so that R@1 hardly depends on the input's last bits, with SIFT and with ALIKED, summer against snow.
_VARIANCE = 0.015  # of a word's Gaussian, in squared lengths of descriptors
_START = 0.5  # of the descriptors' spread
_ITERATIONS = 10
_CHUNK = 2**23  # numbers of an array at a time: few large products, which do not fight over threads


@dataclass(frozen=True)
class VladFitting:
    """Settings of a vocabulary, the centers of a mixture of round Gaussians of equal size, from a few steps of EM.

    This is k-means with soft memberships, so that a change of the last bit of a descriptor hardly changes the words. It
    starts at a normal sample with the descriptors' mean and covariance.

    Raises:
        InputError: `max_samples` is less than `num_words`.
    """

    num_words: int = setting(64, whole(1, 4096))
    power: float = setting(0.5, POSITIVE)  # exponent of the power law
    max_samples: int = setting(100_000, COUNT)  # descriptors to learn from
    seed: int = setting(0, INDEX)  # of the random images and of the start

    def __post_init__(self) -> None:
        check_fields(self)
        if self.max_samples < self.num_words:
            expected = f"at least one for each of num_words={self.num_words} words"
            raise InputError(f"max_samples={self.max_samples}: expected {expected}")

    def fit(self, database: FeatureSet) -> "Vlad":
        """Learn the vocabulary from random images of the database, or from all if they have few descriptors."""
        counts = database.counts
        if counts.sum() < self.num_words:
            expected = f"at least one local feature for each of num_words={self.num_words} words"
            got = f"{counts.sum()} in {len(database)} database images; check images and extractor, or lower num_words"
            raise InputError(f"VLAD: expected {expected}, got {got}")
        rng = np.random.default_rng(self.seed)
        rows = rng.permutation(len(database))  # whole images: one more feature in an image leaves the others' as is
        num_images = 1 + np.searchsorted(np.cumsum(counts[rows]), self.max_samples)
        descriptors = [image.descriptors for _, image in database.read(rows[:num_images].tolist())]
        centers = _mixture_centers(np.concatenate(descriptors)[: self.max_samples], self.num_words, rng)
        return Vlad(centers.astype(np.float32), self.power)


@dataclass(frozen=True)
class Vlad:
    """A vocabulary of visual words `centers`, and the power law's exponent."""

    centers: Float[np.ndarray, "words dimensions"]
    power: float = 0.5

    @property
    def vector_size(self) -> int:
        """Length of a global descriptor: words times dimensions."""
        return self.centers.size

    def __call__(self, images: Sequence[Features]) -> Float[np.ndarray, "images _"]:
        """Global descriptors of unit length, float32; zero if an image has no features."""
        # All images at once: few large operations instead of many small ones.
        per_image = [features.descriptors[features.mask] for features in images]
        descriptors = np.concatenate(per_image)
        if descriptors.shape[1] != self.centers.shape[1]:
            expected = f"{self.centers.shape[1]} dimensions, as those that it was fitted on"
            raise InputError(f"VLAD: expected descriptors of {expected}, got {descriptors.shape[1]}; fit it again")
        # No matrix product: its threads stay awake for a while and take the cores from the matching that comes next.
        products = np.vecdot(descriptors[:, None], self.centers)
        word = np.argmin((self.centers**2).sum(1) - 2 * products, axis=1)  # the first on a tie
        cell = np.repeat(np.arange(len(images)) * len(self.centers), list(map(len, per_image))) + word
        order = np.argsort(cell, kind="stable")
        occupied, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
        residuals = np.zeros((len(images) * len(self.centers), self.centers.shape[1]), np.float32)
        if len(order):
            sums = np.add.reduceat(descriptors[order], starts)
            residuals[occupied] = sums - counts[:, None] * self.centers[occupied % len(self.centers)]
        vlad = _unit_length(residuals)
        vlad = np.sign(vlad) * np.abs(vlad) ** self.power
        return _unit_length(vlad.reshape(len(images), self.vector_size))


def _mixture_centers(
    sample: Float[np.ndarray, "samples dimensions"], num_words: int, rng: np.random.Generator
) -> Float[np.ndarray, "words dimensions"]:
    """Centers of the Gaussians, float64; a center without members stays."""
    mean, dimension = sample.mean(axis=0, dtype=np.float64), sample.shape[1]
    covariance = sum((chunk - mean).T @ (chunk - mean) for chunk in _chunks(sample, num_words)) / len(sample)
    spread = np.linalg.cholesky(covariance + 1e-9 * np.eye(dimension))
    centers = mean + _START * rng.standard_normal((num_words, dimension)) @ spread.T
    for _ in range(_ITERATIONS):
        members, sums = np.zeros((num_words, 1)), np.zeros_like(centers)
        for chunk in _chunks(sample, num_words):
            # Squared distances, up to a term that is the same for all centers.
            distances = (centers**2).sum(1) - 2 * chunk @ centers.T
            shares = scipy.special.softmax(-distances / (2 * _VARIANCE), axis=1)
            members += shares.sum(axis=0)[:, None]
            sums += shares.T @ chunk
        centers = np.where(members > 0, sums / np.where(members > 0, members, 1), centers)
    return centers


def _chunks(sample: Float[np.ndarray, "samples dimensions"], num_words: int) -> Iterator[np.ndarray]:
    rows = max(1, _CHUNK // max(num_words, sample.shape[1]))
    return (sample[start : start + rows].astype(np.float64) for start in range(0, len(sample), rows))


def _unit_length(vectors: Float[np.ndarray, "vectors dimensions"]) -> Float[np.ndarray, "vectors dimensions"]:
    """Scale to unit length along the last axis; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
