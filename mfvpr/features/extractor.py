"""Protocols of extractors, aggregations and sources of features, and the descriptions that they return."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Num

from mfvpr.core.types import Features
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.feature_set import FeatureSet, FeatureSource


class Scale(NamedTuple):
    """One scale of an extractor's local features."""

    dimension: int  # D of the descriptors
    typical_count: int  # usual number of features in an image
    weight: float = 1.0  # weight of the scale's score when the scores of several scales are fused


class Description(NamedTuple):
    """Global descriptor and local features of one image, as NumPy arrays.

    vector: global descriptor of unit length, or several; None = no global descriptor.
    local: Features by scale, without padding (mask all True); () = no local features.
    """

    vector: Float[np.ndarray, " dimensions"] | Float[np.ndarray, "vectors dimensions"] | None = None
    local: tuple[Features, ...] = ()

    @property
    def features(self) -> Features:
        """The features of the only scale.

        Raises:
            ValueError: there are several scales, or none.
        """
        if len(self.local) != 1:
            raise ValueError(f"expected features of one scale, got {len(self.local)}; see `local`")
        return self.local[0]


def local_features(
    keypoints: Num[np.ndarray, "keypoints 2"],
    descriptors: Float[np.ndarray, "keypoints dimensions"],
    image_size: Sequence[int],
    scores: Float[np.ndarray, " keypoints"] | None = None,
) -> Features:
    """Features of one image without padding, from keypoints (x, y) px; scores are 1 by default."""
    size = np.array(image_size, np.float32)
    return Features.of(keypoints.astype(np.float32), descriptors, scores=scores, image_size=size)


@runtime_checkable
class Extractor(Protocol):
    """Images, uint8 RGB -> a Description of each.

    A cache on disk needs the `recipe` of an extractor of your own, see `mfvpr.utils.recipe_of`.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) that images are resized to, px."""
        ...

    @property
    def interpolation(self) -> Interpolation:
        """Interpolation of the resizing, see `mfvpr.datasets.image_reading.resize`."""
        ...

    @property
    def batch_size(self) -> int:
        """Images per call."""
        ...

    @property
    def vector_size(self) -> int:
        """Length of the global descriptor; 0 = no global descriptor."""
        ...

    @property
    def scales(self) -> tuple[Scale, ...]:
        """Scales of the local features; () = no local features."""
        ...

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptions of images of `image_size`; networks raise an `InputError` for images of another size."""
        ...


class Aggregation(Protocol):
    """Local features -> a global descriptor of each image, of unit length."""

    @property
    def vector_size(self) -> int:
        """Length of a global descriptor."""
        ...

    def __call__(self, images: Sequence[Features]) -> Float[np.ndarray, "images dimensions"]: ...


class Fitting(Protocol):
    """Settings of an aggregation that is learned from the database."""

    def fit(self, database: FeatureSet) -> Aggregation:
        """Fit the aggregation to the database's local features; equal features give equal aggregations."""
        ...


@runtime_checkable
class Source(Protocol):
    """Local features of folders of images that were extracted elsewhere."""

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) of the images that the keypoints are in, px; None = the size of the image files."""
        ...

    @property
    def interpolation(self) -> Interpolation:
        """Interpolation of the resizing to `image_size`."""
        ...

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The only scale."""
        ...

    def open(self, folder: ImageFolder, *, partial: bool) -> FeatureSource:
        """The features of a folder's images; if `partial`, features of some images may be missing."""
        ...


@dataclass(frozen=True)
class Aggregated:
    """Global descriptors that are aggregated from local features, by an aggregation that is fitted to the database."""

    extractor: Extractor | Source
    fitting: Fitting
