"""Images -> local Features, images -> global descriptors: what puts OpenCV or a network to work.

Both kinds take a batch of images that were squashed to the size they ask for, so that whoever feeds them (threads that
decode while the device works) need not know what they are.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from mfvpr.data.images import Interpolation
from mfvpr.types import Features


class LocalExtractor(Protocol):
    """Images `[B, H, W, 3]` uint8 RGB -> one unpadded Features per image (NumPy, mask all True)."""

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
    def dimension(self) -> int:
        """D of the descriptors."""
        ...

    @property
    def typical_count(self) -> int:
        """Features that an image has, roughly: for forecasts of disk space."""
        ...

    def __call__(self, images: np.ndarray) -> list[Features]: ...


class GlobalExtractor(Protocol):
    """Images, or the local features already taken from them -> descriptors `[B, D]` of unit length."""

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(width, height) that images are squashed to; None = reads the local features alone."""
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
    def dimension(self) -> int:
        """D of the descriptors."""
        ...

    @property
    def typical_count(self) -> int:
        """1: descriptors of an image."""
        ...

    def __call__(self, images: np.ndarray | None, features: Sequence[Features]) -> np.ndarray: ...
