"""VLAD of local features (Jegou et al., CVPR 2010): a filter without a download.

Residuals to the nearest visual word are summed per word, each sum is normalized by itself (intra-normalization,
Arandjelovic & Zisserman, CVPR 2013), then signed square root (power law) and unit length.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2

from mfvpr.data.images import Interpolation
from mfvpr.errors import InputError
from mfvpr.types import Features


@dataclass(frozen=True)
class Vlad:
    """A vocabulary of M visual words `centers` `[M, D]`, and the power law's exponent."""

    centers: np.ndarray  # [M, D]
    power: float = 0.5
    image_size: None = None  # reads features, no pixels
    interpolation: Interpolation = "pil_bilinear"
    batch_size: int = 64
    typical_count: int = 1

    @property
    def dimension(self) -> int:
        """Words x dimension of the local descriptors."""
        return self.centers.size

    def __call__(self, images: np.ndarray | None, features: Sequence[Features]) -> np.ndarray:
        """`[B, M * D]` float32 descriptors of unit length; zero where an image has no features."""
        return np.stack([self._describe(one.descriptors[one.mask]) for one in features])

    def _describe(self, descriptors: np.ndarray) -> np.ndarray:
        word = _nearest(descriptors, self.centers)
        members = (word[None] == np.arange(len(self.centers))[:, None]).astype(np.float32)  # [M, n]
        residuals = members @ descriptors - members.sum(1, keepdims=True) * self.centers
        vlad = _normalized(residuals)
        vlad = np.sign(vlad) * np.abs(vlad) ** self.power
        return _normalized(vlad.reshape(-1))


def fit_vlad(
    database: Sequence[Features], *, num_words: int = 64, power: float = 0.5, max_samples: int = 20_000, seed: int = 0
) -> Vlad:
    """Vocabulary by k-means (SciPy's, from random members) on at most `max_samples` database descriptors.

    Raises:
        InputError: the database has fewer descriptors than `num_words`.
    """
    descriptors = np.concatenate([features.descriptors[features.mask] for features in database])
    if len(descriptors) < num_words:
        raise InputError(
            f"{len(descriptors)} local features in {len(database)} database images: expected at least one for each of "
            f"the {num_words} words; check the images and the features' settings, or lower retrieval.num_words"
        )
    rng = np.random.default_rng(seed)
    sample = descriptors[rng.choice(len(descriptors), min(max_samples, len(descriptors)), replace=False)]
    with warnings.catch_warnings():  # a word that nobody chose keeps its place, which does no harm here
        warnings.filterwarnings("ignore", message="One of the clusters is empty")
        warnings.filterwarnings("ignore", category=RuntimeWarning)  # the same, on duplicated images
        # Not from k-means++, whose start takes 25 times as long as all iterations together.
        centers, _ = kmeans2(sample, num_words, iter=25, minit="points", missing="warn", rng=rng)
    return Vlad(centers.astype(np.float32), power)


def _nearest(descriptors: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """`[n]` index of the nearest center, the first on a tie."""
    return np.argmin((centers**2).sum(1) - 2 * descriptors @ centers.T, axis=1)


def _normalized(vectors: np.ndarray) -> np.ndarray:
    """Unit length along the last axis; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
