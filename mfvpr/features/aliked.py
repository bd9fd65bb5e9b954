"""ALIKED's local features (Zhao et al., IEEE TIM 2023), 128 dimensions; 64 of the smallest network."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description, Scale
from mfvpr.features.network import compiled, in_batches, require_size
from mfvpr.networks.aliked import Aliked
from mfvpr.networks.aliked_detection import RADIUS, Detections
from mfvpr.types import Features
from mfvpr.utils.errors import InputError

_SMALLEST = 2 * RADIUS + 1  # px: one pixel within the border, which has no keypoints
_PIXELS_PER_SLOT = 40  # photographs have a keypoint in 65 px at most


@dataclass(frozen=True)
class AlikedFeatures:
    """What the public code extracts, in its order: row by row; by falling score where there are too many.

    Attributes:
        model: the network with its weights.
        image_size: (width, height) px.
        interpolation: see `mfvpr.datasets.images.resize`.
        threshold: of the detection score, in (0, 1). 0.1 is that of Pivonka & Preucil (IEEE T-IV 2024); its authors'
            default is 0.2. Where no score of an image is above it, those above the image's mean are taken.
        max_keypoints: those of the highest scores are kept; None = all.
        batch_size: images per call.

    Raises:
        InputError: images of this size have no room for a keypoint.
    """

    model: Aliked
    image_size: tuple[int, int] = (320, 320)
    interpolation: Interpolation = "pil_bilinear"
    threshold: float = 0.1
    max_keypoints: int | None = 5000
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        if min(self.image_size) < _SMALLEST:
            width, height = self.image_size
            raise InputError(f"ALIKED: expected images of {_SMALLEST} x {_SMALLEST} px or more, got {width} x {height}")

    @property
    def vector_size(self) -> int:
        """0: there is no global descriptor."""
        return 0

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One, of 128 dimensions, or 64 of the smallest network.

        One keypoint in 125 px, or `max_keypoints`; aliked-n16rot and aliked-n32 find half to two thirds of that.
        """
        return (Scale(self.model.dimension, min(self._limit, math.prod(self.image_size) // 125)),)

    def __call__(self, images: np.ndarray) -> list[Description]:
        """Local features of each image `[B, H, W, 3]` RGB, 0 .. 255.

        Raises:
            InputError: the images do not have the size asked for.
        """
        require_size("ALIKED", images, self.image_size)
        usual = min(self._limit, math.ceil(math.prod(self.image_size) / _PIXELS_PER_SLOT))
        found = in_batches(self._program(usual), images, self.batch_size)
        crowded = [row for row, (detections, _) in enumerate(found) if detections.count > usual]
        if crowded and usual < self._limit:
            most = max(int(found[row][0].count) for row in crowded)
            roomy = min(self._limit, 1 << (most - 1).bit_length())  # a power of two: few programs, whatever comes
            again = in_batches(self._program(roomy), images[crowded], self.batch_size)
            for row, result in zip(crowded, again, strict=True):
                found[row] = result
        return [Description(local=(self._features(*result),)) for result in found]

    @property
    def _limit(self) -> int:
        pixels = math.prod(self.image_size)
        return pixels if self.max_keypoints is None else min(self.max_keypoints, pixels)

    @cached_property
    def _program(self) -> Callable[[int], Callable[[Any], Any]]:
        """By the number of keypoint slots."""

        def program(capacity: int) -> Callable[[Any], Any]:
            def extract(model: Aliked, images: Array) -> tuple[Detections, Array]:
                return model.extract(images.astype(jnp.float32) / 255, self.threshold, capacity)

            return compiled(self.model, extract)

        return cache(program)

    def _features(self, detections: Detections, descriptors: np.ndarray) -> Features:
        kept = np.flatnonzero(detections.mask)
        return Features(
            keypoints=np.asarray(detections.keypoints)[kept],
            descriptors=descriptors[kept],
            scores=np.asarray(detections.scores)[kept],
            mask=np.ones(len(kept), bool),
            image_size=np.array(self.image_size, np.float32),
        )
