"""Generalized mean pooling (Radenovic et al., TPAMI 2019) on VGG16 or ResNet-50, as in CosPlace (CVPR 2022)."""

from typing import Literal

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.imagenet import Images, of_unit_length, preprocess
from mfvpr.networks.resnet import ResNet50
from mfvpr.networks.vgg import Vgg16, require_position

Backbone = Literal["vgg16", "resnet50"]

_BACKBONES = {"vgg16": (Vgg16, 512), "resnet50": (ResNet50, 2048)}  # with the channels of their maps
_MIN_VALUE = 1e-6  # before pooling, as published


class GeneralizedMean(nnx.Module):
    """(mean_p max(x_p, 1e-6)^power)^(1 / power) of each channel: power 1 is the mean, infinity the maximum."""

    def __init__(self, power: float = 3.0) -> None:
        self.power = nnx.Param(jnp.full(1, power, jnp.float32))

    def __call__(self, maps: Float[Array, "batch height width channels"]) -> Float[Array, "batch channels"]:
        power, values = self.power[...][0], jnp.maximum(maps, _MIN_VALUE)
        largest = jnp.max(values, axis=(1, 2), keepdims=True)  # a divisor, so that powers of small values do not vanish
        means = jnp.mean((values / largest) ** power, axis=(1, 2))
        return largest[:, 0, 0] * means ** (1 / power)


class Gem(nnx.Module):
    """Generalized mean of a backbone's last map, of unit length at each position, and a projection to `outputs`.

    The backbone is VGG16 to `conv5_3`, before its ReLU, or ResNet-50 without its classifier.
    """

    def __init__(
        self, backbone: Backbone = "resnet50", outputs: int = 2048, *, precision: str = "highest", rngs: nnx.Rngs
    ) -> None:
        backbone_class, channels = _BACKBONES[backbone]
        self.backbone = backbone_class(precision=precision, rngs=rngs)
        self.pool = GeneralizedMean()
        self.projection = nnx.Linear(channels, outputs, precision=precision, rngs=rngs)
        self.dimension = outputs
        self.has_components = False

    require = staticmethod(require_position)
    preprocess = staticmethod(preprocess)

    def __call__(self, images: Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length of preprocessed images."""
        return of_unit_length(self.projection(self.pool(of_unit_length(self.backbone(images)))))
