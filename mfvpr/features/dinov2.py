"""DINOv2's features of patches (Oquab et al., TMLR 2024): tokens, or values of the attention as in EffoVPR."""

from dataclasses import dataclass, field
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, require_network
from mfvpr.networks.layers import of_unit_length
from mfvpr.networks.vit import PATCH, VisionTransformer, require_patches
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import SIZE, check_fields, number, setting, whole, word_of

Facet = Literal["token", "query", "key", "value"]

_MIDDLE = (PATCH - 1) / 2  # px from a patch's first pixel to its middle


@dataclass(frozen=True)
class Dinov2Features(NetworkExtractor):
    """Class token as global descriptor, and a local feature of unit length for each patch of 14 x 14 px.

    Keypoints are the middles of the patches, in row order. A score is the class token's attention to the patch in
    `block`, the mean over the heads, divided by the image's largest.

        features = Dinov2Features(load_model("dinov2_vitl14"), (504, 504), facet="value", block=-2)  # as EffoVPR's

    Attributes, beside those of `Extractor`:
        image_size: (width, height) px, multiples of 14.
        facet: local features: "token" takes the normalized tokens after the block, "query", "key" and "value" take
            these parts of the block's attention, with all heads.
        block: index of the block; -1 is the last, -2 the block before it.
        threshold: keep patches with at least this score; 0 keeps all, 1 keeps the best.

    Raises:
        InputError: another network, an unknown facet, no such block, a threshold above 1, or an image size that is no
            multiple of 14.
    """

    model: VisionTransformer = field(repr=False)
    image_size: tuple[int, int] = setting((336, 336), SIZE, "width, height, multiples of 14")
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    facet: Facet = setting(
        "token",
        word_of(Facet),
        "token: the normalized tokens after the block; query, key, value: parts of the block's attention",
    )
    block: int = setting(-1, whole(-24, 23), "from the last, -1, backward; or from the first, 0, forward")
    threshold: float = setting(
        0.0,
        number(0, 1),
        "keep patches with at least this share of the class token's largest attention to a patch; 0 = all",
    )
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        require_network("DINOv2", self.model, VisionTransformer)
        require_patches(self.image_size)
        if not -(depth := len(self.model.blocks)) <= self.block < depth:
            raise InputError(f"block={self.block}: expected from {-depth} to {depth - 1}, a block of this network")

    @property
    def vector_size(self) -> int:
        """Length of the class token."""
        return self.model.width

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with all patches, also if `threshold` drops some."""
        width, height = self.image_size
        return (Scale(self.model.width, (width // PATCH) * (height // PATCH)),)

    def compute(
        self, model: VisionTransformer, images: jax.Array
    ) -> tuple[
        Float[jax.Array, "batch width"],
        Float[jax.Array, "batch rows columns width"],
        Float[jax.Array, "batch rows columns"],
    ]:
        """Global descriptors, local descriptors and scores."""
        tokens, output = model.with_block(model.preprocess(images), self.block)
        scores = output.attention / jnp.max(output.attention, axis=(1, 2), keepdims=True)
        return of_unit_length(tokens.class_token), of_unit_length(getattr(output, self.facet)), scores

    def _describe(
        self,
        result: tuple[np.ndarray, Float[np.ndarray, "rows columns dimensions"], Float[np.ndarray, "rows columns"]],
    ) -> Description:
        vector, local, scores = result
        row, column = np.nonzero(scores >= self.threshold)
        keypoints = _MIDDLE + PATCH * np.stack([column, row], axis=1)
        features = local_features(keypoints, local[row, column], self.image_size, scores[row, column])
        return Description(vector, (features,))
