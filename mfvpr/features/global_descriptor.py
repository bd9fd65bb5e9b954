"""Global descriptors of networks: MixVPR, the paper's retrieval; NetVLAD, generalized mean pooling, transformers."""

from dataclasses import dataclass, field
from typing import Protocol

import jax
from jaxtyping import Float

from mfvpr.datasets.image_reading import Interpolation
from mfvpr.features.network import NetworkExtractor
from mfvpr.networks.layers import Images, Pixels, of_unit_length
from mfvpr.networks.mixvpr import IMAGE_SIZE, MixVPR
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import SIZE, check_fields, setting, whole, word_of


@dataclass(frozen=True)
class MixVprDescriptor(NetworkExtractor):
    """MixVPR's global descriptors, as the public code extracts them.

    Attributes, beside those of `Extractor`:
        model: the network with its weights, which are for 320 x 320 px only.
        interpolation: the authors' demonstration and OpenVPRLab use "pil_bicubic", the authors' training
            "pil_bilinear", VPR-methods-evaluation "torch_bilinear".
    """

    image_size = IMAGE_SIZE
    model: MixVPR = field(repr=False)  # 4096, 512 or 128 numbers with published weights
    interpolation: Interpolation = setting(
        "pil_bicubic",
        word_of(Interpolation),
        "the authors' demo, OpenVPRLab; pil_bilinear (training), torch_bilinear (VPR-methods-evaluation)",
    )
    batch_size: int = setting(8, whole(1, 256), recipe=False)


class DescriptorNetwork(Protocol):
    """A network that maps preprocessed images to descriptors of unit length.

    `has_components` says whether a descriptor consists of principal components, the largest first. `require` raises an
    InputError if the network cannot take images of this (width, height) px.
    """

    dimension: int
    has_components: bool

    def require(self, size: tuple[int, int]) -> None: ...

    def preprocess(self, images: Pixels) -> Images: ...

    def __call__(self, images: Images) -> Float[jax.Array, "images dimensions"]: ...


@dataclass(frozen=True)
class GlobalDescriptor(NetworkExtractor):
    """Global descriptors of a network that takes images of many sizes, as the public code extracts them.

    Attributes, beside those of `Extractor`:
        image_size: (width, height) px; 640 x 480 is Patch-NetVLAD's.
        components: number of principal components that are kept, scaled to unit length again; None = all.

    Raises:
        InputError: the network cannot take images of this size, or has fewer principal components.
    """

    model: DescriptorNetwork = field(repr=False)
    image_size: tuple[int, int] = setting((640, 480), SIZE, "width, height")
    interpolation: Interpolation = setting("pil_bilinear", word_of(Interpolation))
    components: int | None = setting(
        None, whole(1, 4096) | None, "how many of the first of 4096, 512 or 128 are kept; null = all"
    )
    batch_size: int = setting(8, whole(1, 256), recipe=False)

    def __post_init__(self) -> None:
        check_fields(self)
        self.model.require(self.image_size)
        if self.components is not None and not self.model.has_components:
            raise InputError(f"components={self.components}: expected None, since these weights have no whitening")
        if self.components is not None and not 1 <= self.components <= self.model.dimension:
            raise InputError(f"components={self.components}: expected from 1 to {self.model.dimension}")

    @property
    def vector_size(self) -> int:
        return self.components or self.model.dimension

    def compute(self, model: DescriptorNetwork, images: jax.Array) -> jax.Array:
        descriptors = model(model.preprocess(images))
        return descriptors if self.components is None else of_unit_length(descriptors[:, : self.components])
