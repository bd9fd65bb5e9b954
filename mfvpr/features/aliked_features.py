"""ALIKED's local features (Zhao et al., IEEE TIM 2023), 128 dimensions; 64 of the smallest network."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Num

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network, in_batches
from mfvpr.networks.aliked import STRIDE, Aliked, Detections
from mfvpr.utils.fields import NOT_NEGATIVE, SHAPED_SIZE, SIZE, check_fields, setting, whole, word_of

_PIXELS_PER_SLOT = 40  # photographs have a keypoint in 65 px at most


@dataclass(frozen=True)
class AlikedFeatures(NetworkExtractor):
    """ALIKED's keypoints and descriptors, as the public code extracts them.

    Keypoints are in row order, or by falling score if an image has more than `max_keypoints`.

    Attributes, beside those of `Extractor`:
        threshold: of the detection score, in (0, 1). 0.1 is that of Pivonka & Preucil (IEEE T-IV 2024); its authors'
            default is 0.2. If no score of an image is above it, keypoints above the image's mean score are taken.
        max_keypoints: the keypoints of the highest scores are kept; None = all.

    Raises:
        InputError: a value that is out of its range.
    """

    vector_size = 0  # no global descriptor
    side_multiple = STRIDE  # px: other images are padded, which costs recall
    model: Aliked = field(repr=False)
    image_size: tuple[int, int] = setting((320, 320), SIZE, SHAPED_SIZE)
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    threshold: float = setting(0.1, NOT_NEGATIVE, "of the detection score: the paper's; its authors' default is 0.2")
    max_keypoints: int | None = setting(5000, whole(1, 20_000) | None, "the highest scores are kept; null = all")
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale of 128 dimensions, or 64 of the smallest network.

        Images have one keypoint in 125 px, or `max_keypoints`; with aliked-n16rot and aliked-n32, half to two thirds.
        """
        return (Scale(self.model.dimension, min(self._limit, math.prod(self.image_size) // 125)),)

    def _extract(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        usual = min(self._limit, math.ceil(math.prod(self.image_size) / _PIXELS_PER_SLOT))
        extracted = in_batches(self._program(usual), images, self.batch_size)
        counts = [int(detections.count) for detections, _ in extracted]
        crowded = [row for row, count in enumerate(counts) if count > usual]
        if crowded and usual < self._limit:
            # Powers of two: few programs for all images.
            capacity = min(self._limit, 1 << (max(counts) - 1).bit_length())
            again = in_batches(self._program(capacity), images[crowded], self.batch_size)
            for row, result in zip(crowded, again, strict=True):
                extracted[row] = result
        return extracted

    @property
    def _limit(self) -> int:
        pixels = math.prod(self.image_size)
        return pixels if self.max_keypoints is None else min(self.max_keypoints, pixels)

    @cached_property
    def _program(self) -> Callable[[int], Callable[[Any], Any]]:
        """The compiled network for a number of keypoint slots."""

        def extract(model: Aliked, images: Array, *, capacity: int) -> tuple[Detections, Array]:
            return model.extract(images.astype(jnp.float32) / 255, self.threshold, capacity)

        return cache(lambda capacity: compile_network(self.model, partial(extract, capacity=capacity)))

    def _describe(self, result: tuple[Detections, Float[np.ndarray, "slots dimensions"]]) -> Description:
        detections, descriptors = result
        keypoints, scores, mask = map(np.asarray, (detections.keypoints, detections.scores, detections.mask))
        features = local_features(keypoints[mask], descriptors[mask], self.image_size, scores[mask])
        return Description(local=(features,))
