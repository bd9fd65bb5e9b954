"""Extractors, aggregations and sources of features, as protocols, and the descriptions that they give."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.images import Interpolation
from mfvpr.features.feature_set import FeatureSet, FeatureSource
from mfvpr.types import Features


class Scale(NamedTuple):
    """Local features of one scale.

    dimension: D of the descriptors.
    typical_count: of an image's features, for forecasts of space.
    weight: of its score, where those of several scales are fused.
    """

    dimension: int
    typical_count: int
    weight: float = 1.0


class Description(NamedTuple):
    """What one pass over an image gives. NumPy.

    vector: `[D]` global descriptor of unit length, or several `[V, D]`; None = none.
    local: Features by scale, unpadded, mask all True; () = none.
    """

    vector: np.ndarray | None = None
    local: tuple[Features, ...] = ()

    @property
    def features(self) -> Features:
        """Of the only scale.

        Raises:
            ValueError: there are several, or none.
        """
        if len(self.local) != 1:
            raise ValueError(f"expected features of one scale, got {len(self.local)}; see `local`")
        return self.local[0]


@runtime_checkable
class Extractor(Protocol):
    """Images `[B, H, W, 3]` uint8 RGB -> a Description of each.

    With a store its recipe is needed, see `mfvpr.utils.fingerprints.recipe_of`: a frozen dataclass has one.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) that images are squashed to."""
        ...

    @property
    def interpolation(self) -> Interpolation:
        """How they are squashed."""
        ...

    @property
    def batch_size(self) -> int:
        """Images per call."""
        ...

    @property
    def vector_size(self) -> int:
        """Numbers of the global descriptor; 0 = there is none."""
        ...

    @property
    def scales(self) -> tuple[Scale, ...]:
        """Of the local features; () = there are none."""
        ...

    def __call__(self, images: np.ndarray) -> list[Description]: ...


class Aggregation(Protocol):
    """Local features -> a global descriptor of each image `[B, D]` of unit length."""

    @property
    def vector_size(self) -> int:
        """D."""
        ...

    def __call__(self, images: Sequence[Features]) -> np.ndarray: ...


class Fitting(Protocol):
    """What an aggregation is before it has seen the database."""

    def fit(self, database: FeatureSet) -> Aggregation:
        """Fitted on the database's local features; the same ones give the same aggregation."""
        ...


@runtime_checkable
class Source(Protocol):
    """What has local features of folders of images, without extracting them."""

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) of the images that the keypoints are in; None = as the files are."""
        ...

    @property
    def interpolation(self) -> Interpolation:
        """How images are squashed to it."""
        ...

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One."""
        ...

    def opened(self, folder: ImageFolder, *, partial: bool) -> FeatureSource:
        """The features of a folder's images; `partial`: some may be missing."""
        ...


@dataclass(frozen=True)
class Aggregated:
    """Global descriptors that are computed from an extractor's local features, once the database's are known."""

    extractor: Extractor | Source
    fitting: Fitting
