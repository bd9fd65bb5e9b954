"""MixVPR (Ali-bey et al., WACV 2023): one descriptor of a whole image, from feature maps mixed by small perceptrons.

Each of the backbone's 1024 feature maps is a vector of 20 x 20 positions; four mixers add to it what a perceptron makes
of it, the same for all maps; then two projections reduce the number of maps and the number of positions.
"""

import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.networks.imagenet import DEVIATION, MEAN
from mfvpr.networks.lengths import of_unit_length
from mfvpr.networks.resnet import ResNet50

IMAGE_SIZE = (320, 320)  # px, width and height, to which the mixers' weights belong
_CHANNELS, _POSITIONS = 1024, 20 * 20  # of the backbone's maps
_NORM_EPSILON = 1e-5  # the published weights'; Flax's default of 1e-6 changes descriptors where maps are faint


class FeatureMixer(nnx.Module):
    """Adds to each map a perceptron's answer to its positions: LayerNorm, Linear, ReLU, Linear."""

    def __init__(self, size: int, *, precision: str, rngs: nnx.Rngs) -> None:
        self.norm = nnx.LayerNorm(size, epsilon=_NORM_EPSILON, use_fast_variance=False, rngs=rngs)
        self.linear1 = nnx.Linear(size, size, precision=precision, rngs=rngs)
        self.linear2 = nnx.Linear(size, size, precision=precision, rngs=rngs)

    def __call__(self, maps: Array) -> Array:
        """`[B, C, positions]` -> the same shape."""
        return maps + self.linear2(nnx.relu(self.linear1(self.norm(maps))))


class MixVPR(nnx.Module):
    """ResNet-50 to its third layer, four mixers, two projections.

    Args:
        out_channels: maps after the projection; published: 1024, 256, 64.
        out_rows: values per map after the projection; published: 4, 2, 2.
        precision: of the products where the hardware offers less than float32.
    """

    def __init__(
        self, out_channels: int = 1024, out_rows: int = 4, *, precision: str = "highest", rngs: nnx.Rngs
    ) -> None:
        self.dimension = out_channels * out_rows
        self.precision = precision
        self.backbone = ResNet50("layer3", precision=precision, rngs=rngs)
        self.mix = nnx.List([FeatureMixer(_POSITIONS, precision=precision, rngs=rngs) for _ in range(4)])
        self.channel_proj = nnx.Linear(_CHANNELS, out_channels, precision=precision, rngs=rngs)
        self.row_proj = nnx.Linear(_POSITIONS, out_rows, precision=precision, rngs=rngs)

    def __call__(self, images: Array) -> Array:
        """Descriptors `[B, D]` of unit length, D = channels x rows, from preprocessed images `[B, 320, 320, 3]`.

        Raises:
            ValueError: images of another size.
        """
        if images.shape[1:3] != IMAGE_SIZE[::-1]:
            height, width = images.shape[1:3]
            raise ValueError(f"MixVPR takes images of 320 x 320 px only, got {width} x {height}")
        return self.aggregate(self.backbone(images))

    def aggregate(self, maps: Array) -> Array:
        """Descriptors `[B, D]` of unit length from the backbone's maps `[B, 20, 20, 1024]`."""
        maps = maps.reshape(len(maps), _POSITIONS, _CHANNELS).swapaxes(1, 2)
        for mixer in self.mix:
            maps = mixer(maps)
        descriptors = self._projected(maps).reshape(len(maps), self.dimension)
        return of_unit_length(descriptors)

    def _projected(self, maps: Array) -> Array:
        """Channel projection, then row projection: `[B, 1024, positions]` -> `[B, channels, rows]`.

        Both are linear and act on different axes, so the rows, of which few remain, may be projected first: 1/6 of the
        mixers' and projections' time less. The channels' bias is then summed over the rows' kernel.
        """
        channels, rows = self.channel_proj, self.row_proj
        kernel = rows.kernel[...]
        bias = jnp.outer(kernel.sum(0), channels.bias[...]) + rows.bias[...][:, None]  # pyright: ignore  (never None)
        narrow = jnp.matmul(maps, kernel, precision=self.precision).swapaxes(1, 2)  # [B, rows, 1024]
        projected = jnp.matmul(narrow, channels.kernel[...], precision=self.precision) + bias[None]
        return projected.swapaxes(1, 2)


def preprocess(images: Array) -> Array:
    """`[B, H, W, 3]` RGB, 0 .. 255, uint8 or float32 -> what the network takes, float32."""
    mean, deviation = (jnp.array(values, jnp.float32)[None, None, None] for values in (MEAN, DEVIATION))
    return (images.astype(jnp.float32) / 255 - mean) / deviation
