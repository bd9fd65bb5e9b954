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
    image_size: tuple[int, int] = (640, 480)
    interpolation: Interpolation = "pil_bilinear"
    patch_sizes: tuple[int, ...] = (5,)
    scale_weights: tuple[float, ...] | None = field(default=None, metadata={"recipe": False})
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        require_network("Patch-NetVLAD", self.model, VggNetVlad)
        columns, rows = self._map_size
        if not self.patch_sizes or not 1 <= min(self.patch_sizes) <= max(self.patch_sizes) <= min(columns, rows):
            raise InputError(f"patch_sizes={list(self.patch_sizes)}: expected sizes from 1 to {min(columns, rows)}, as "
                             f"a map of {columns} x {rows} positions has room for")  # fmt: skip
        if len(set(self.patch_sizes)) < len(self.patch_sizes):
            raise InputError(f"patch_sizes={list(self.patch_sizes)}: expected each size once")
        if self.scale_weights is not None and len(self.scale_weights) != len(self.patch_sizes):
            raise InputError(f"scale_weights={list(self.scale_weights)}: expected one for each of "
                             f"patch_sizes={list(self.patch_sizes)}, or None")  # fmt: skip

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
