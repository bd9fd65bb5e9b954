"""MixVPR's global descriptors (Ali-bey et al., WACV 2023), 4096, 512 or 128 dimensions: the paper's filter."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description, Scale
from mfvpr.features.network import compiled, in_batches, require_size
from mfvpr.networks.mixvpr import IMAGE_SIZE, MixVPR, preprocess


@dataclass(frozen=True)
class MixVprDescriptor:
    """What the public code extracts.

    Attributes:
        model: the network with its weights.
        interpolation: see `mfvpr.datasets.images.resize`. "pil_bicubic" is that of the authors' demonstration and of
            OpenVPRLab, "pil_bilinear" their training's, "torch_bilinear" VPR-methods-evaluation's.
        batch_size: images per call.
    """

    model: MixVPR
    interpolation: Interpolation = "pil_bicubic"
    batch_size: int = field(default=8, metadata={"recipe": False})

    @property
    def image_size(self) -> tuple[int, int]:
        """(320, 320), the only one the weights are for."""
        return IMAGE_SIZE

    @property
    def scales(self) -> tuple[Scale, ...]:
        """(): there are no local features."""
        return ()

    @property
    def vector_size(self) -> int:
        """4096, 512 or 128 with published weights."""
        return self.model.dimension

    def __call__(self, images: np.ndarray) -> list[Description]:
        """`[D]` float32 descriptors of unit length, of images `[B, 320, 320, 3]` RGB, 0 .. 255, uint8 or float32.

        Raises:
            InputError: the images have another size.
        """
        require_size("MixVPR", images, IMAGE_SIZE)
        return [Description(np.asarray(vector)) for vector in in_batches(self._program, images, self.batch_size)]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return compiled(self.model, _describe)


def _describe(model: MixVPR, images: jax.Array) -> jax.Array:
    return model(preprocess(images))
