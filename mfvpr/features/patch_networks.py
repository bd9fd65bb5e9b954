"""Global descriptors with a local feature for every patch of an image, of one pass of a network.

DINOv2 (Oquab et al., TMLR 2024); SelaVPR (Lu et al., ICLR 2024); Patch-NetVLAD (Hausler et al., CVPR 2021). Keypoints
are the middles of the patches, in row order.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor
from mfvpr.networks.backbones import STRIDE
from mfvpr.networks.global_descriptors import VggNetVlad
from mfvpr.networks.layers import of_unit_length
from mfvpr.networks.vit import LOCAL, PATCH, SelaVpr, VisionTransformer, require_patches
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import POSITIVE, SIZE, list_of, number, setting, whole, word_of

Facet = Literal["token", "query", "key", "value"]

_MIDDLE = (PATCH - 1) / 2  # px from a patch's first pixel to its middle
_STEP = PATCH / 4  # px between positions of SelaVPR's map, which was upsampled twice
_MIDDLE_OF_STRIDE = (STRIDE - 1) // 2  # px, of Patch-NetVLAD's positions, as published: a half is dropped


@dataclass(frozen=True)
class Dinov2Features(NetworkExtractor):
    """Class token as global descriptor, and a local feature of unit length for each patch of 14 x 14 px.

    A score is the class token's attention to the patch in `block`, the mean over the heads, divided by the image's
    largest.

        features = Dinov2Features(load_model("dinov2_vitl14"), (504, 504), facet="value", block=-2)  # as EffoVPR's

    Raises:
        InputError: no such block, or an image size that is no multiple of 14.
    """

    network = VisionTransformer
    image_size: tuple[int, int] = setting((336, 336), SIZE, "width, height, multiples of 14")
    facet: Facet = setting(
        "token", word_of(Facet), "token: normalized, after the block; query, key, value of its attention, all heads"
    )
    block: int = setting(-1, whole(-24, 23), "from the last, -1, backward; or from the first, 0, forward")
    threshold: float = setting(
        0.0, number(0, 1), "keep patches with at least this share of the class token's largest attention; 0 = all"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_patches(self.image_size)
        if not -(depth := len(self.model.blocks)) <= self.block < depth:
            raise InputError(f"block={self.block}: expected from {-depth} to {depth - 1}, a block of this network")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with all patches, also if `threshold` drops some."""
        width, height = self.image_size
        return (Scale(self.model.dimension, (width // PATCH) * (height // PATCH)),)

    def compute(self, model: VisionTransformer, images: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Global descriptors `[B, D]`, local ones `[B, rows, columns, D]` and attention `[B, rows, columns]`."""
        tokens, output = model.with_block(model.preprocess(images), self.block)
        return of_unit_length(tokens.class_token), of_unit_length(getattr(output, self.facet)), output.attention

    def describe_result(self, result: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Description:
        vector, local, attention = result
        scores = attention / np.max(attention)  # here, so that the largest is 1
        row, column = np.nonzero(scores >= self.threshold)
        keypoints = _MIDDLE + PATCH * np.stack([column, row], axis=1)
        features = local_features(keypoints, local[row, column], self.image_size, scores[row, column])
        return Description(vector, (features,))


@dataclass(frozen=True)
class SelaVprFeatures(NetworkExtractor):
    """Global descriptor and dense local features, as the public code extracts them; scores are 1.

    Keypoints are interpolated between the middles of the network's patches; the public code has no keypoints, because
    its score does not depend on them. Published are images of 224 x 224 px, resized without antialiasing and rounding.

    Raises:
        InputError: an image size that is no multiple of 14.
    """

    network = SelaVpr
    image_size: tuple[int, int] = setting((224, 224), SIZE, "width, height, multiples of 14")
    interpolation: Interpolation = setting("torch_no_antialias", word_of(Interpolation))

    def __post_init__(self) -> None:
        super().__post_init__()
        require_patches(self.image_size)

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One scale with every position of the map."""
        columns, rows = (4 * (side // PATCH) - 3 for side in self.image_size)
        return (Scale(LOCAL, columns * rows),)

    def describe_result(self, result: tuple[np.ndarray, Float[np.ndarray, "rows columns dimensions"]]) -> Description:
        vector, local = result
        row, column = np.indices(local.shape[:2]).reshape(2, -1)
        keypoints = _MIDDLE + _STEP * np.stack([column, row], axis=1)
        return Description(vector, (local_features(keypoints, local.reshape(-1, LOCAL), self.image_size),))


@dataclass(frozen=True)
class PatchNetVladFeatures(NetworkExtractor):
    """NetVLAD of the image and of all square patches of its map, as the public code extracts them; scores are 1.

    Each of the `patch_sizes` is a scale; for `scale_weights` see `mfvpr.evaluation.fuse_scales`.

    Raises:
        InputError: a patch is larger than the map, or there are not as many weights as patch sizes.
    """

    network = VggNetVlad
    image_size: tuple[int, int] = setting((640, 480), SIZE, "width, height")
    patch_sizes: tuple[int, ...] = setting(
        (5,), list_of(whole(1, 64)), "positions of the map, 16 px each; of several, each is a scale, scored by itself"
    )
    scale_weights: tuple[float, ...] | None = setting(
        None, list_of(POSITIVE) | None, "of the scales' standardized scores; null = 1 each", recipe=False
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        columns, rows = self._map_size
        if max(self.patch_sizes) > min(columns, rows):
            expected = f"sizes from 1 to {min(columns, rows)}, as a map of {columns} x {rows} positions has room for"
            raise InputError(f"patch_sizes={list(self.patch_sizes)}: expected {expected}")
        if self.scale_weights is not None and len(self.scale_weights) != len(self.patch_sizes):
            expected = f"one for each of patch_sizes={list(self.patch_sizes)}, or None"
            raise InputError(f"scale_weights={list(self.scale_weights)}: expected {expected}")

    @property
    def scales(self) -> tuple[Scale, ...]:
        """One for each size of patches."""
        columns, rows = self._map_size
        weights = self.scale_weights or (1.0,) * len(self.patch_sizes)
        return tuple(
            Scale(self.model.dimension, (columns - size + 1) * (rows - size + 1), weight)
            for size, weight in zip(self.patch_sizes, weights, strict=True)
        )

    @property
    def _map_size(self) -> tuple[int, int]:
        return self.image_size[0] // STRIDE, self.image_size[1] // STRIDE

    def compute(self, model: VggNetVlad, images: jax.Array) -> Any:
        return model.with_patches(model.preprocess(images), self.patch_sizes)

    def describe_result(self, result: tuple[np.ndarray, tuple[np.ndarray, ...]]) -> Description:
        local, (vector, patches), (columns, rows) = [], result, self._map_size
        for size, descriptors in zip(self.patch_sizes, patches, strict=True):
            row, column = np.indices((rows - size + 1, columns - size + 1)).reshape(2, -1)
            middle = STRIDE * np.stack([column, row], axis=1) + STRIDE * (size - 1) // 2 + _MIDDLE_OF_STRIDE
            local.append(local_features(middle, descriptors, self.image_size))
        return Description(vector, tuple(local))
