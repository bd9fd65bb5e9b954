"""VGG16 (Simonyan & Zisserman, ICLR 2015) and ResNet-50 (He et al., CVPR 2016) up to a named layer, and SSM-VPR's maps.

ResNet-50 is "v1.5", with strides in the 3 x 3 convolutions. Batch normalization uses its running statistics, since the
networks only extract features.
"""

from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
from flax import nnx
from jax import lax
from jaxtyping import Bool, Float

from mfvpr.core.types import Array
from mfvpr.networks.layers import BatchNorm, Conv3x3, Images, Linear, conv, preprocess
from mfvpr.utils.errors import InputError

STRIDE = 16  # px between positions of the last block's map
STAGE1_STRIDE, STAGE2_STRIDE = 16, 8  # px between positions of SSM-VPR's maps
Pool = Literal["max", "max_ceil", "average"]

_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
LAYERS = {
    f"conv{block}_{place}": width
    for block, widths in enumerate(_WIDTHS, start=1)
    for place, width in enumerate(widths, start=1)
}


class Vgg16(nnx.Module):
    """3 x 3 convolutions `conv1_1`, `conv1_2`, `conv2_1`, ... that keep the size, with ReLU and pooling.

    Args:
        last: the last convolution; the output is before its ReLU.
        pools: after block 1, 2, ...: "max" halves the map (2 x 2, stride 2, drops an odd last row or column);
            "max_ceil" also pools an odd last row or column; "average" smooths the map (2 x 2, stride 1, no padding:
            one row and one column fewer).
        dilations: of the convolutions of block 1, 2, ...
    """

    def __init__(
        self,
        last: str = "conv5_3",
        *,
        pools: tuple[Pool, ...] = ("max",) * 4,
        dilations: tuple[int, ...] = (1,) * 5,
        rngs: nnx.Rngs,
    ) -> None:
        names = tuple(LAYERS)
        self.layers = names[: names.index(last) + 1]
        self.pools = pools
        inputs = 3
        for name in self.layers:
            setattr(self, name, Conv3x3(inputs, LAYERS[name], dilation=dilations[int(name[4]) - 1], rngs=rngs))
            inputs = LAYERS[name]

    def __call__(
        self, images: Images, layer: str | None = None, *, uniform: bool | Bool[Array, ""] = False
    ) -> Float[Array, "batch rows columns channels"]:
        """Map before the ReLU of a layer, by default the last; later layers do not run. `uniform` as in `Conv3x3`."""
        x = images
        for name in self.layers[: self.layers.index(layer or self.layers[-1]) + 1]:
            if name != self.layers[0]:
                x = _pool_relu(x, self.pools[int(name[4]) - 2]) if name.endswith("_1") else nnx.relu(x)
            x = getattr(self, name)(x, uniform)
        return x


def _pool_relu(x: Array, pool: Pool) -> Array:
    """ReLU and pooling. A maximum comes first, which gives the same with a quarter of the work."""
    if pool == "average":
        x = nnx.relu(x)
        return (x[:, :-1, :-1] + x[:, :-1, 1:] + x[:, 1:, :-1] + x[:, 1:, 1:]) / 4
    if pool == "max_ceil":
        x = jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, x.shape[2] % 2), (0, 0)), mode="edge")
    height, width = x.shape[1] // 2 * 2, x.shape[2] // 2 * 2
    # Slices: a window reduction does not fuse with its neighbors on a CPU.
    rows = jnp.maximum(x[:, 0:height:2, :width], x[:, 1:height:2, :width])
    return nnx.relu(jnp.maximum(rows[:, :, 0::2], rows[:, :, 1::2]))


def require_position(size: tuple[int, int]) -> None:
    """Raise an InputError if images of this (width, height) px are too small for the last block."""
    if min(size) < STRIDE:
        raise InputError(f"image_size={list(size)}: expected {STRIDE} x {STRIDE} px or more; enlarge the images")


class SsmVgg(nnx.Module):
    """The network of SSM-VPR (Camara et al., ICRA 2020): two maps of a VGG16, trained on Places365.

    Stage 1, which chooses the shortlist, uses `conv5_2`; stage 2, which ranks it, uses `conv4_2`; both before their
    ReLU. Pooling rounds sizes up, so a map has ceil(H / stride) x ceil(W / stride) positions.
    """

    def __init__(self, *, rngs: nnx.Rngs) -> None:
        self.vgg = Vgg16("conv5_2", pools=("max_ceil",) * 4, rngs=rngs)

    preprocess = staticmethod(preprocess)  # published with "torch", although the weights were trained with "caffe"

    def __call__(self, images: Images, stage: Literal[1, 2]) -> Float[Array, "batch rows columns 512"]:
        """The map of a stage, of preprocessed images."""
        return self.vgg(images, {1: "conv5_2", 2: "conv4_2"}[stage])


_EXPANSION = 4  # channels of a block's output per channel inside
_LAYERS = {"layer1": (3, 64), "layer2": (4, 128), "layer3": (6, 256), "layer4": (3, 512)}  # blocks, channels inside


class Bottleneck(nnx.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions with a shortcut, which is a 1 x 1 convolution if the width changes.

    1 x 1 convolutions are matrix products, which are faster on a CPU.
    """

    def __init__(self, inputs: int, width: int, *, stride: int, rngs: nnx.Rngs) -> None:
        outputs = _EXPANSION * width
        self.conv1 = Linear(inputs, width, use_bias=False, rngs=rngs)
        self.bn1 = BatchNorm(width, rngs=rngs)
        if stride == 1:
            self.conv2 = Conv3x3(width, width, use_bias=False, rngs=rngs)
        else:
            self.conv2 = conv(width, width, stride=stride, rngs=rngs)
        self.bn2 = BatchNorm(width, rngs=rngs)
        self.conv3 = Linear(width, outputs, use_bias=False, rngs=rngs)
        self.bn3 = BatchNorm(outputs, rngs=rngs)
        self.stride, self.has_projection = stride, inputs != outputs
        if self.has_projection:
            self.shortcut = Linear(inputs, outputs, use_bias=False, rngs=rngs)
            self.shortcut_bn = BatchNorm(outputs, rngs=rngs)

    def __call__(self, x: Float[Array, "batch rows columns inputs"]) -> Float[Array, "batch _ _ outputs"]:
        shortcut = x
        if self.has_projection:
            shortcut = self.shortcut_bn(self.shortcut(x[:, :: self.stride, :: self.stride]))
        x = nnx.relu(self.bn1(self.conv1(x)))
        x = nnx.relu(self.bn2(self.conv2(x)))
        return _compute_once(lambda x, shortcut: nnx.relu(self.bn3(x) + shortcut), self.conv3(x), shortcut)


class ResNet50(nnx.Module):
    """ResNet-50: `conv1`, `bn1`, a max pooling, then `layer1`, `layer2`, ..., which are lists of bottlenecks.

    `last` is the last layer: "layer1" to "layer4", of 256, 512, 1024, 2048 channels and stride 4, 8, 16, 32.
    """

    def __init__(self, last: str = "layer4", *, rngs: nnx.Rngs) -> None:
        names = tuple(_LAYERS)
        self.layers = names[: names.index(last) + 1]
        self.conv1 = conv(3, 64, 7, stride=2, rngs=rngs)
        self.bn1 = BatchNorm(64, rngs=rngs)
        inputs = 64
        for name in self.layers:
            blocks, width = _LAYERS[name]
            layer = nnx.List([])
            for place in range(blocks):
                layer.append(Bottleneck(inputs, width, stride=2 if place == 0 and name != "layer1" else 1, rngs=rngs))
                inputs = _EXPANSION * width
            setattr(self, name, layer)

    def __call__(self, images: Images) -> Float[Array, "batch rows columns channels"]:
        x = nnx.relu(self.bn1(self.conv1(images)))
        around = ((1, 1), (1, 1))  # one pixel of minus infinity; Flax's annotation allows names only
        x = nnx.max_pool(x, (3, 3), strides=(2, 2), padding=around)  # pyright: ignore[reportArgumentType]
        for name in self.layers:
            for block in getattr(self, name):
                x = block(x)
        return x


def _compute_once(function: Callable[[Array, Array], Array], x: Array, y: Array) -> Array:
    """Result of a function of two maps of one size, computed only once on a CPU.

    XLA's CPU compiler recomputes a cheap sum for each of its uses, and thus the whole chain of residuals, which doubles
    MixVPR's time. It removes `optimization_barrier` before this step, but keeps a condition, here one that is true for
    every number and for NaN. The compilers of other platforms do not need it.
    """

    def behind_condition(x: Array, y: Array) -> Array:
        return lax.cond(x[(0,) * x.ndim] * 0 != 1, function, lax.sub, x, y)

    return lax.platform_dependent(x, y, cpu=behind_condition, default=function)
