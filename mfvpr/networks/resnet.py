"""ResNet-50 (He et al., CVPR 2016) "v1.5", with strides in the 3 x 3 convolutions, up to a named layer.

Batch normalization uses its running statistics, since the network only extracts features.
"""

from collections.abc import Callable

from flax import nnx
from jax import lax
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.layers import BatchNorm, Conv3x3, Images, PointwiseConv, conv

_EXPANSION = 4  # channels of a block's output per channel inside
_LAYERS = {"layer1": (3, 64), "layer2": (4, 128), "layer3": (6, 256), "layer4": (3, 512)}  # blocks, channels inside


class Bottleneck(nnx.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions with a shortcut, which is a 1 x 1 convolution if the width changes."""

    def __init__(self, inputs: int, width: int, *, stride: int, rngs: nnx.Rngs) -> None:
        outputs = _EXPANSION * width
        self.conv1 = PointwiseConv(inputs, width, rngs=rngs)
        self.bn1 = BatchNorm(width, rngs=rngs)
        if stride == 1:
            self.conv2 = Conv3x3(width, width, use_bias=False, rngs=rngs)
        else:
            self.conv2 = conv(width, width, stride=stride, rngs=rngs)
        self.bn2 = BatchNorm(width, rngs=rngs)
        self.conv3 = PointwiseConv(width, outputs, rngs=rngs)
        self.bn3 = BatchNorm(outputs, rngs=rngs)
        self.has_projection = inputs != outputs
        if self.has_projection:
            self.shortcut = PointwiseConv(inputs, outputs, stride=stride, rngs=rngs)
            self.shortcut_bn = BatchNorm(outputs, rngs=rngs)

    def __call__(self, x: Float[Array, "batch rows columns inputs"]) -> Float[Array, "batch _ _ outputs"]:
        shortcut = self.shortcut_bn(self.shortcut(x)) if self.has_projection else x
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
