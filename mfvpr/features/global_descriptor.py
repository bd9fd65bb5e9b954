"""Global descriptors of networks that take images of many sizes: NetVLAD, generalized mean pooling, transformers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Float, Num

from mfvpr.datasets.images import Interpolation
from mfvpr.features.extractor import Description
from mfvpr.features.network import compile_network, in_batches, require_size
from mfvpr.networks.lengths import of_unit_length
from mfvpr.utils.errors import InputError


class DescriptorNetwork(Protocol):
    """A network that maps preprocessed images to descriptors of unit length."""

    @property
    def dimension(self) -> int:
        """Length of a descriptor."""
        ...

    @property
    def has_components(self) -> bool:
        """Whether a descriptor consists of principal components, the largest first."""
        ...

    def require(self, size: tuple[int, int]) -> None:
        """Raise an InputError if the network cannot take images of this (width, height) px."""
        ...

    def preprocess(
        self, images: Num[jax.Array, "images height width 3"]
    ) -> Float[jax.Array, "images height width 3"]: ...

    def __call__(self, images: Float[jax.Array, "images height width 3"]) -> Float[jax.Array, "images dimensions"]: ...


@dataclass(frozen=True)
class GlobalDescriptor:
    """A network's global descriptors, as the public code extracts them.

    Attributes, beside those of `Extractor`:
        image_size: (width, height) px; 640 x 480 is Patch-NetVLAD's.
        components: number of principal components that are kept, scaled to unit length again; None = all.

    Raises:
        InputError: the network cannot take images of this size, or has fewer principal components.
    """

    scales = ()  # no local features
    model: DescriptorNetwork
    image_size: tuple[int, int] = (640, 480)
    interpolation: Interpolation = "pil_bilinear"
    components: int | None = None
    batch_size: int = field(default=8, metadata={"recipe": False})

    def __post_init__(self) -> None:
        self.model.require(self.image_size)
        if self.components is not None and not self.model.has_components:
            raise InputError(f"components={self.components}: expected None, since these weights have no whitening")
        if self.components is not None and not 1 <= self.components <= self.model.dimension:
            raise InputError(f"components={self.components}: expected from 1 to {self.model.dimension}")

    @property
    def vector_size(self) -> int:
        return self.components or self.model.dimension

    def __call__(self, images: Num[np.ndarray, "images height width 3"]) -> list[Description]:
        """Descriptors of unit length, float32, of images, RGB, 0 .. 255, uint8 or float32."""
        require_size(type(self.model).__name__, images, self.image_size)
        return [Description(vector) for vector in in_batches(self._program, images, self.batch_size)]

    @cached_property
    def _program(self) -> Callable[..., Any]:
        def describe(model: Any, images: jax.Array) -> jax.Array:
            descriptors = model(model.preprocess(images))
            return descriptors if self.components is None else of_unit_length(descriptors[:, : self.components])

        return compile_network(self.model, describe)  # pyright: ignore[reportArgumentType]  (a module, whatever else it is)
