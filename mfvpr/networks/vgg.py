"""VGG16 (Simonyan & Zisserman, ICLR 2015) up to a named convolution: a backbone of several networks."""

from typing import Literal

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Bool, Float

from mfvpr.core.types import Array
from mfvpr.networks.convolution import Conv3x3
from mfvpr.networks.imagenet import Images
from mfvpr.utils.errors import InputError

STRIDE = 16  # px between positions of the last block's map
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
        pools: tuple[Pool, ...] = ("max", "max", "max", "max"),
        dilations: tuple[int, ...] = (1, 1, 1, 1, 1),
        precision: str = "highest",
        rngs: nnx.Rngs,
    ) -> None:
        names = tuple(LAYERS)
        self.layers = names[: names.index(last) + 1]
        self.pools = pools
        inputs = 3
        for name in self.layers:
            dilation = dilations[_block(name) - 1]
            setattr(self, name, Conv3x3(inputs, LAYERS[name], dilation=dilation, precision=precision, rngs=rngs))
            inputs = LAYERS[name]

    def __call__(
        self, images: Images, layer: str | None = None, *, uniform: bool | Bool[Array, ""] = False
    ) -> Float[Array, "batch rows columns channels"]:
        """Map before the ReLU of a layer, by default the last; later layers do not run. `uniform` as in `Conv3x3`."""
        x = images
        for name in self.layers[: self.layers.index(layer or self.layers[-1]) + 1]:
            if name != self.layers[0]:
                x = _POOLS[self.pools[_block(name) - 2]](x) if name.endswith("_1") else nnx.relu(x)
            x = getattr(self, name)(x, uniform)
        return x


def require_position(size: tuple[int, int]) -> None:
    """Raise an InputError if images of this (width, height) px are too small for the last block."""
    if min(size) < STRIDE:
        raise InputError(f"image_size={list(size)}: expected {STRIDE} x {STRIDE} px or more")


def _block(name: str) -> int:
    return int(name[len("conv")])


def _max_pool(x: Array) -> Array:
    """Maximum, then ReLU, which equals the other order with a quarter of the work."""
    # Slices: a window reduction does not fuse with its neighbors on a CPU.
    height, width = x.shape[1] // 2 * 2, x.shape[2] // 2 * 2
    top, bottom = x[:, 0:height:2, :width], x[:, 1:height:2, :width]
    rows = jnp.maximum(top, bottom)
    return nnx.relu(jnp.maximum(rows[:, :, 0::2], rows[:, :, 1::2]))


def _max_pool_ceil(x: Array) -> Array:
    """As `_max_pool`, but keep an odd last row or column."""
    odd = ((0, 0), (0, x.shape[1] % 2), (0, x.shape[2] % 2), (0, 0))
    return _max_pool(jnp.pad(x, odd, mode="edge"))


def _average_pool(x: Array) -> Array:
    x = nnx.relu(x)
    return (x[:, :-1, :-1] + x[:, :-1, 1:] + x[:, 1:, :-1] + x[:, 1:, 1:]) / 4


_POOLS = {"max": _max_pool, "max_ceil": _max_pool_ceil, "average": _average_pool}
