"""The networks of SSM-VPR (Camara et al., ICRA 2020): two maps of one VGG16.

It was trained on Places365 (Zhou et al., TPAMI 2017). The first stage, which chooses the shortlist, uses `conv5_2`;
the second stage, which ranks it, uses `conv4_2`; both before their ReLU. Pooling rounds sizes up, so a map has
ceil(H / stride) x ceil(W / stride) positions.
"""

from flax import nnx
from jaxtyping import Float

from mfvpr.networks.imagenet import Images, preprocess
from mfvpr.networks.vgg import Vgg16
from mfvpr.types import Array

STAGE1_LAYER, STAGE2_LAYER = "conv5_2", "conv4_2"
STAGE1_STRIDE, STAGE2_STRIDE = 16, 8  # px between positions of the maps


class SsmVgg(nnx.Module):
    """VGG16 to `conv5_2`; `precision` is of products on hardware with less than float32."""

    def __init__(self, *, precision: str = "highest", rngs: nnx.Rngs) -> None:
        self.vgg = Vgg16(STAGE1_LAYER, pools=("max_ceil",) * 4, precision=precision, rngs=rngs)

    preprocess = staticmethod(preprocess)  # published with "torch", although the weights were trained with "caffe"

    def __call__(self, images: Images) -> tuple[Float[Array, "batch _ _ 512"], Float[Array, "batch _ _ 512"]]:
        """`stage1` and `stage2` of the same images, in one pass."""
        first, second = self.vgg.maps(images, (STAGE1_LAYER, STAGE2_LAYER))
        return first, second

    def stage1(self, images: Images) -> Float[Array, "batch rows columns 512"]:
        """The first map of preprocessed images."""
        return self.vgg(images)

    def stage2(self, images: Images) -> Float[Array, "batch rows columns 512"]:
        """The second map of preprocessed images."""
        (second,) = self.vgg.maps(images, (STAGE2_LAYER,))
        return second
