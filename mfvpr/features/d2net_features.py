"""D2-Net's local features (Dusmanu et al., CVPR 2019), 512 dimensions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Num

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, compile_network, in_batches, require_at_least
from mfvpr.networks.d2net import SCALES, STRIDE, D2Net, Detections, extract, map_size
from mfvpr.networks.layers import Preprocessing
from mfvpr.utils.fields import FLAG, SHAPED_SIZE, SIZE, check_fields, setting, whole, word_of

_SHARE = 0.3  # keypoint slots per position of a map; photographs take about a tenth
_SMALLEST_MAP = 2


@dataclass(frozen=True)
class D2NetFeatures(NetworkExtractor):
    """D2-Net's keypoints and descriptors, as the public code extracts them and in its order.

    Scores are activations, which are not comparable between images.

    Attributes, beside those of `Extractor`:
        preprocessing: "caffe" as published, or "torch".
        multiscale: detect at half, full and double size as well, in this order.
        max_keypoints: the keypoints of the highest scores are kept, in the same order; None = all.

    Raises:
        InputError: images of this size are too small for the network.
    """

    vector_size = 0  # no global descriptor
    model: D2Net = field(repr=False)
    image_size: tuple[int, int] = setting((336, 336), SIZE, SHAPED_SIZE)
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    preprocessing: Preprocessing = setting("caffe", word_of(Preprocessing))
    multiscale: bool = setting(False, FLAG)
    max_keypoints: int | None = setting(
        None, whole(1, 20_000) | None, "the highest scores are kept; null = all, as in the paper"
    )
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        smallest = round((_SMALLEST_MAP + 1) * STRIDE / min(self._network_scales))
        require_at_least("D2-Net, multi-scale" if self.multiscale else "D2-Net", self.image_size, smallest)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale of 512 dimensions, with the features of all of the network's own scales.

        Images have 740 features at 336 x 336 px, in proportion to the map's size, and 1.4 times as many multi-scale.
        """
        width, height = self.image_size
        share = map_size(width) * map_size(height) / map_size(336) ** 2
        usual = round(740 * share * (1.4 if self.multiscale else 1))
        return (Scale(512, usual if self.max_keypoints is None else min(usual, self.max_keypoints)),)

    def _extract(self, images: Num[np.ndarray, "images height width 3"]) -> list[Any]:
        results = in_batches(self._program(_SHARE), images, self.batch_size)
        crowded = [row for row, levels in enumerate(results) if any(level.count > len(level.mask) for level in levels)]
        for row, levels in zip(crowded, in_batches(self._program(1.0), images[crowded], self.batch_size), strict=True):
            results[row] = levels
        return results

    @property
    def _network_scales(self) -> tuple[float, ...]:
        return SCALES if self.multiscale else (1.0,)

    @cached_property
    def _program(self) -> Callable[[float], Callable[..., Any]]:
        """The compiled network for a share of positions that have a keypoint slot."""
        function = partial(extract, preprocessing=self.preprocessing, scales=self._network_scales)
        return cache(lambda share: compile_network(self.model, partial(function, share=share)))

    def _describe(self, result: tuple[Detections, ...]) -> Description:
        keypoints, descriptors, scores = (
            np.concatenate([getattr(level, name)[level.mask] for level in result])
            for name in ("keypoints", "descriptors", "scores")
        )
        strongest = np.sort(np.argsort(-scores, kind="stable")[: self.max_keypoints])
        features = local_features(keypoints[strongest], descriptors[strongest], self.image_size, scores[strongest])
        return Description(local=(features,))
