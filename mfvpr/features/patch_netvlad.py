"""Patch-NetVLAD's features (Hausler et al., CVPR 2021): NetVLAD of all square patches of a map, of several sizes."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Features
from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.extractor import Description, Scale, local_features
from mfvpr.features.network import NetworkExtractor, require_network
from mfvpr.networks.netvlad import VggNetVlad
from mfvpr.networks.vgg import STRIDE
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import POSITIVE, SIZE, check_fields, list_of, setting, whole, word_of

_MIDDLE = (STRIDE - 1) // 2  # px from a position's first pixel, as published: a half is dropped


@dataclass(frozen=True)
class PatchNetVladFeatures(NetworkExtractor):
    """Global descriptor and patch descriptors, as the public code extracts them.

    Patches are in row order; their scores are 1.

    Attributes, beside those of `Extractor`:
        patch_sizes: sides of the patches, in positions of the map; each size is a scale.
        scale_weights: weight of each scale's score, see `mfvpr.evaluation.fuse_scales`; None = equal weights.

    Raises:
        InputError: another network; no patch sizes, duplicates, or a patch that is larger than the map; another number
            of weights than of patch sizes.
    """

    model: VggNetVlad = field(repr=False)
    image_size: tuple[int, int] = setting((640, 480), SIZE, "width, height")
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    patch_sizes: tuple[int, ...] = setting(
        (5,),
        list_of(whole(1, 64)),
        "positions of the map, 16 px each; of several, each is a scale, scored by itself",
    )
    scale_weights: tuple[float, ...] | None = setting(
        None,
        list_of(POSITIVE) | None,
        "of the scales' scores, each standardized over a query's candidates; null = 1 each",
        recipe=False,
    )
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        require_network("Patch-NetVLAD", self.model, VggNetVlad)
        columns, rows = self._map_size
        if max(self.patch_sizes) > min(columns, rows):
            expected = f"sizes from 1 to {min(columns, rows)}, as a map of {columns} x {rows} positions has room for"
            raise InputError(f"patch_sizes={list(self.patch_sizes)}: expected {expected}")
        if len(set(self.patch_sizes)) < len(self.patch_sizes):
            raise InputError(f"patch_sizes={list(self.patch_sizes)}: expected each size once")
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
        width, height = self.image_size
        return width // STRIDE, height // STRIDE

    def compute(self, model: VggNetVlad, images: jax.Array) -> Any:
        return model.with_patches(model.preprocess(images), self.patch_sizes)

    def _describe(self, result: tuple[np.ndarray, tuple[np.ndarray, ...]]) -> Description:
        vector, patches = result
        return Description(vector, tuple(map(self._features, self.patch_sizes, patches)))

    def _features(self, size: int, descriptors: Float[np.ndarray, "keypoints dimensions"]) -> Features:
        columns, rows = (side - size + 1 for side in self._map_size)
        row, column = np.indices((rows, columns)).reshape(2, -1)
        middle = STRIDE * np.stack([column, row], axis=1) + STRIDE * (size - 1) // 2 + _MIDDLE
        return local_features(middle, descriptors, self.image_size)
