"""The networks of SSM-VPR (Camara et al., ICRA 2020): two maps of one VGG16.

It was trained on Places365 (Zhou et al., TPAMI 2017). The first stage, which chooses the shortlist, uses `conv5_2`;
the second stage, which ranks it, uses `conv4_2`; both before their ReLU. Pooling rounds sizes up, so a map has
ceil(H / stride) x ceil(W / stride) positions.
"""

from typing import Literal

from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.imagenet import Images, preprocess
from mfvpr.networks.vgg import Vgg16

_LAYERS = {1: "conv5_2", 2: "conv4_2"}
STAGE1_STRIDE, STAGE2_STRIDE = 16, 8  # px between positions of the maps


class SsmVgg(nnx.Module):
    """VGG16 to `conv5_2`."""

    def __init__(self, *, precision: str = "highest", rngs: nnx.Rngs) -> None:
        self.vgg = Vgg16(_LAYERS[1], pools=("max_ceil",) * 4, precision=precision, rngs=rngs)

    preprocess = staticmethod(preprocess)  # published with "torch", although the weights were trained with "caffe"

    def __call__(self, images: Images, stage: Literal[1, 2]) -> Float[Array, "batch rows columns 512"]:
        """The map of a stage, of preprocessed images."""
        return self.vgg(images, _LAYERS[stage])
