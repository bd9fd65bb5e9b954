"""SelaVPR's features (Lu et al., ICLR 2024): a global descriptor and a dense map of local descriptors."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import compile_network, in_batches, require_network, require_size
from mfvpr.networks.selavpr import LOCAL, SelaVpr
from mfvpr.networks.vit import PATCH, require_patches
from mfvpr.types import Features

_STEP = PATCH / 4  # px between positions of the local map, which was upsampled twice
_MIDDLE = (PATCH - 1) / 2  # px from a patch's first pixel to its middle


@dataclass(frozen=True)
class SelaVprFeatures:
    """Global descriptor and dense local features, as the public code extracts them.

    Local features are in row order; their scores are 1. Their keypoints are interpolated between the middles of the
    network's patches; the public code has no keypoints, because its score does not depend on them.

    Attributes, beside those of `Extractor`:
        image_size: (width, height) px, multiples of 14; 224 x 224 is published.
        interpolation: published without antialiasing and without rounding.

    Raises:
        InputError: another network, or an image size that is no multiple of 14.
    """

    model: SelaVpr
    image_size: tuple[int, int] = (224, 224)
    interpolation: Interpolation = "torch_no_antialias"
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        require_network("SelaVPR", self.model, SelaVpr)
        require_patches(self.image_size)

    @property
    def vector_size(self) -> int:
        return self.model.dimension

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with every position of the map."""
        columns, rows = self._map_size
        return (Scale(LOCAL, columns * rows),)

    @property
    def _map_size(self) -> tuple[int, int]:
        width, height = (4 * (side // PATCH) - 3 for side in self.image_size)
        return width, height

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptors of images, RGB, 0 .. 255, uint8 or float32."""
        require_size("SelaVPR", images, self.image_size)
        pairs = in_batches(self._program, images, self.batch_size)
        return [Description(vector, (self._features(local),)) for vector, local in pairs]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return compile_network(self.model, lambda model, images: model(model.preprocess(images)))

    def _features(self, local: Float[np.ndarray, "rows columns dimensions"]) -> Features:
        row, column = np.indices(local.shape[:2]).reshape(2, -1)
        keypoints = _MIDDLE + _STEP * np.stack([column, row], axis=1)
        return local_features(keypoints, local.reshape(-1, LOCAL), self.image_size)
