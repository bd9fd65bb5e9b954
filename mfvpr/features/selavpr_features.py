"""SelaVPR's features (Lu et al., ICLR 2024): a global descriptor and a dense map of local descriptors."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, require_network
from mfvpr.networks.vit import LOCAL, PATCH, SelaVpr, require_patches
from mfvpr.utils.fields import SIZE, check_fields, setting, whole, word_of

_STEP = PATCH / 4  # px between positions of the local map, which was upsampled twice
_MIDDLE = (PATCH - 1) / 2  # px from a patch's first pixel to its middle


@dataclass(frozen=True)
class SelaVprFeatures(NetworkExtractor):
    """Global descriptor and dense local features, as the public code extracts them.

    Local features are in row order; their scores are 1. Their keypoints are interpolated between the middles of the
    network's patches; the public code has no keypoints, because its score does not depend on them.

    Attributes, beside those of `Extractor`:
        image_size: (width, height) px, multiples of 14; 224 x 224 is published.
        interpolation: published without antialiasing and without rounding.

    Raises:
        InputError: another network, or an image size that is no multiple of 14.
    """

    model: SelaVpr = field(repr=False)
    image_size: tuple[int, int] = setting((224, 224), SIZE, "width, height, multiples of 14")
    interpolation: Interpolation = setting("torch_no_antialias", word_of(Interpolation))
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        require_network("SelaVPR", self.model, SelaVpr)
        require_patches(self.image_size)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with every position of the map."""
        columns, rows = self._map_size
        return (Scale(LOCAL, columns * rows),)

    @property
    def _map_size(self) -> tuple[int, int]:
        width, height = (4 * (side // PATCH) - 3 for side in self.image_size)
        return width, height

    def _describe(self, result: tuple[np.ndarray, Float[np.ndarray, "rows columns dimensions"]]) -> Description:
        vector, local = result
        row, column = np.indices(local.shape[:2]).reshape(2, -1)
        keypoints = _MIDDLE + _STEP * np.stack([column, row], axis=1)
        return Description(vector, (local_features(keypoints, local.reshape(-1, LOCAL), self.image_size),))
