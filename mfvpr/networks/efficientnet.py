"""EfficientNet-Lite0 (Tan & Le, ICML 2019, without its squeeze-and-excitation), up to any of its blocks.

A block is an inverted bottleneck (Sandler et al., CVPR 2018): 1 x 1 convolutions, which are matrix products, and
between them one convolution of each channel by itself.
"""

from functools import partial

import jax.numpy as jnp
from flax import nnx
from jax import lax
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks import layers
from mfvpr.networks.layers import PRECISION, Images, Linear, Pixels

_STEM = 32  # channels
_STAGES = (  # number of blocks; kernel, stride of the first block, expansion, channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
CHANNELS = tuple(channels for number, *_, channels in _STAGES for _ in range(number))  # of each block's map

BatchNorm = partial(layers.BatchNorm, epsilon=1e-3)


class EfficientNetLite0(nnx.Module):
    """A convolution with stride 2, then 16 blocks; strides and padding ("SAME") are TensorFlow's."""

    def __init__(self, *, rngs: nnx.Rngs) -> None:
        options = {"strides": 2, "use_bias": False, "precision": PRECISION}
        self.stem = nnx.Conv(3, _STEM, (3, 3), **options, rngs=rngs)
        self.stem_bn = BatchNorm(_STEM, rngs=rngs)
        self.blocks, inputs = nnx.List([]), _STEM
        for number, size, stride, expansion, channels in _STAGES:
            for place in range(number):
                shape = inputs, channels, expansion * inputs, size, 1 if place else stride
                self.blocks.append(InvertedBottleneck(*shape, rngs=rngs))
                inputs = channels

    @staticmethod
    def preprocess(images: Pixels) -> Images:
        """RGB images from 0 to 255 -> inputs of the network, from -1 to 1."""
        return (images.astype(jnp.float32) - 127) / 128

    def __call__(self, images: Images, block: int) -> Float[Array, "batch rows columns channels"]:
        """The output of a block, 0 to 15, of preprocessed images; later blocks do not run."""
        x = nnx.relu6(self.stem_bn(self.stem(images)))
        for each in self.blocks[: block + 1]:
            x = each(x)
        return x


class InvertedBottleneck(nnx.Module):
    """1 x 1 convolution to `width` channels, if there are fewer; one of each channel; 1 x 1 to `outputs` channels."""

    def __init__(self, inputs: int, outputs: int, width: int, size: int, stride: int, *, rngs: nnx.Rngs) -> None:
        self.stride, self.expands, self.has_shortcut = stride, width > inputs, stride == 1 and inputs == outputs
        if self.expands:
            self.expand, self.expand_bn = Linear(inputs, width, use_bias=False, rngs=rngs), BatchNorm(width, rngs=rngs)
        kernel = nnx.initializers.he_normal()(rngs.params(), (size, size, 1, width), jnp.float32)
        self.depthwise, self.depthwise_bn = nnx.Param(kernel), BatchNorm(width, rngs=rngs)
        self.project, self.project_bn = Linear(width, outputs, use_bias=False, rngs=rngs), BatchNorm(outputs, rngs=rngs)

    def __call__(self, x: Float[Array, "batch rows columns inputs"]) -> Float[Array, "batch _ _ outputs"]:
        wide = nnx.relu6(self.expand_bn(self.expand(x))) if self.expands else x
        shifts, grouped = (partial(convolve, stride=self.stride) for convolve in (_sum_of_shifts, _grouped))
        wide = lax.platform_dependent(wide, self.depthwise[...], cpu=shifts, default=grouped)
        narrow = self.project_bn(self.project(nnx.relu6(self.depthwise_bn(wide))))
        return x + narrow if self.has_shortcut else narrow


def _sum_of_shifts(x: Array, kernel: Array, stride: int) -> Array:
    """Convolution of each channel by itself; XLA's own takes 10 to 70 times as long on a CPU."""
    size, sides = len(kernel), x.shape[1:3]
    rows, columns = (-(-side // stride) for side in sides)
    missing = [max((steps - 1) * stride + size - side, 0) for steps, side in zip((rows, columns), sides, strict=True)]
    x = jnp.pad(x, ((0, 0), *((each // 2, each - each // 2) for each in missing), (0, 0)))
    return layers.sum_of_shifts(x, kernel, stride)


def _grouped(x: Array, kernel: Array, stride: int) -> Array:
    layout = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(
        x, kernel, (stride, stride), "SAME", None, None, layout, x.shape[-1], precision=PRECISION
    )
