"""MixVPR's global descriptors (Ali-bey et al., WACV 2023), 4096, 512 or 128 dimensions: the paper's retrieval."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Num

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description
from mfvpr.features.network import compile_network, in_batches, require_size
from mfvpr.networks.mixvpr import IMAGE_SIZE, MixVPR, preprocess


@dataclass(frozen=True)
class MixVprDescriptor:
    """MixVPR's global descriptors, as the public code extracts them.

    Attributes, beside those of `Extractor`:
        model: the network with its weights, which are for 320 x 320 px only.
        interpolation: the authors' demonstration and OpenVPRLab use "pil_bicubic", the authors' training
            "pil_bilinear", VPR-methods-evaluation "torch_bilinear".
    """

    image_size = IMAGE_SIZE
    scales = ()  # no local features
    model: MixVPR
    interpolation: Interpolation = "pil_bicubic"
    batch_size: int = field(default=8, metadata={"recipe": False})

    @property
    def vector_size(self) -> int:
        """Length of a descriptor: 4096, 512 or 128 with published weights."""
        return self.model.dimension

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptors of unit length, float32, of images, RGB, 0 .. 255, uint8 or float32."""
        require_size("MixVPR", images, IMAGE_SIZE)
        return [Description(vector) for vector in in_batches(self._program, images, self.batch_size)]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        return compile_network(self.model, lambda model, images: model(preprocess(images)))
