"""D2-Net's local features (Dusmanu et al., CVPR 2019), 512 dimensions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description, Scale
from mfvpr.features.network import compiled, in_batches, require_size
from mfvpr.networks.d2net import SCALES, STRIDE, D2Net, Detections, extract, map_size
from mfvpr.networks.imagenet import Preprocessing
from mfvpr.types import Features
from mfvpr.utils.errors import InputError

_SHARE = 0.3  # keypoint slots per position of a map; photographs take about a tenth
_SMALLEST_MAP = 2


@dataclass(frozen=True)
class D2NetFeatures:
    """What the public code extracts, in its order; scores are activations, which other images' do not compare with.

    Attributes:
        model: the network with its weights.
        image_size: (width, height) px.
        interpolation: see `mfvpr.datasets.images.resize`.
        preprocessing: "caffe" as published, or "torch".
        multiscale: detect at half, full and double size as well, in this order.
        max_keypoints: those of the highest scores are kept, in the same order; None = all.
        batch_size: images per call.

    Raises:
        InputError: images of this size are too small for the network.
    """

    model: D2Net
    image_size: tuple[int, int] = (336, 336)
    interpolation: Interpolation = "pil_bilinear"
    preprocessing: Preprocessing = "caffe"
    multiscale: bool = False
    max_keypoints: int | None = None
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        smallest = round((_SMALLEST_MAP + 1) * STRIDE / min(self._network_scales))
        if min(self.image_size) < smallest:
            width, height = self.image_size
            scales = ", multi-scale" if self.multiscale else ""
            raise InputError(
                f"D2-Net{scales}: expected images of {smallest} x {smallest} px or more, got {width} x {height}"
            )

    @property
    def vector_size(self) -> int:
        """0: there is no global descriptor."""
        return 0

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One, of 512 dimensions: all of the network's own scales are one set of features.

        740 at 336 x 336 px, and in proportion to the map's size; 1.4 times as many with all scales.
        """
        width, height = self.image_size
        share = map_size(width) * map_size(height) / map_size(336) ** 2
        usual = round(740 * share * (1.4 if self.multiscale else 1))
        return (Scale(512, usual if self.max_keypoints is None else min(usual, self.max_keypoints)),)

    def __call__(self, images: np.ndarray) -> list[Description]:
        """Local features of each image `[B, H, W, 3]` RGB, 0 .. 255.

        Raises:
            InputError: the images do not have the size asked for.
        """
        require_size("D2-Net", images, self.image_size)
        found = in_batches(self._usual_program, images, self.batch_size)
        crowded = [row for row, levels in enumerate(found) if any(level.count > len(level.mask) for level in levels)]
        for row, levels in zip(crowded, in_batches(self._roomy_program, images[crowded], self.batch_size), strict=True):
            found[row] = levels
        return [Description(local=(self._features(levels),)) for levels in found]

    @property
    def _network_scales(self) -> tuple[float, ...]:
        return SCALES if self.multiscale else (1.0,)

    @cached_property
    def _usual_program(self) -> Callable[..., Any]:
        return self._program(_SHARE)

    @cached_property
    def _roomy_program(self) -> Callable[..., Any]:
        return self._program(1.0)

    def _program(self, share: float) -> Callable[..., Any]:
        function = partial(extract, preprocessing=self.preprocessing, scales=self._network_scales, share=share)
        return compiled(self.model, function)

    def _features(self, levels: tuple[Detections, ...]) -> Features:
        keypoints, descriptors, scores = (
            np.concatenate([getattr(level, name)[level.mask] for level in levels])
            for name in ("keypoints", "descriptors", "scores")
        )
        kept = np.sort(np.argsort(-scores, kind="stable")[: self.max_keypoints])
        return Features(
            keypoints=keypoints[kept],
            descriptors=descriptors[kept],
            scores=scores[kept],
            mask=np.ones(len(kept), bool),
            image_size=np.array(self.image_size, np.float32),
        )
