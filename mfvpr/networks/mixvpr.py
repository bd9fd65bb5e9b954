"""MixVPR (Ali-bey et al., WACV 2023): a global descriptor from feature maps that small perceptrons mix."""

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks.layers import Images, LayerNorm, Linear, bias_of, matmul, of_unit_length, preprocess
from mfvpr.networks.resnet import ResNet50

IMAGE_SIZE = (320, 320)  # px, width and height; the mixers' weights depend on it
_CHANNELS, _POSITIONS = 1024, 20 * 20  # of the backbone's maps


class FeatureMixer(nnx.Module):
    """Perceptron on the positions of each map, with a shortcut: LayerNorm, Linear, ReLU, Linear."""

    def __init__(self, size: int, *, rngs: nnx.Rngs) -> None:
        self.norm = LayerNorm(size, epsilon=1e-5, rngs=rngs)  # published; a smaller one changes faint maps
        self.linear1, self.linear2 = (Linear(size, size, rngs=rngs) for _ in range(2))

    def __call__(self, maps: Float[Array, "batch channels positions"]) -> Float[Array, "batch channels positions"]:
        return maps + self.linear2(nnx.relu(self.linear1(self.norm(maps))))


class MixVPR(nnx.Module):
    """ResNet-50 to its third layer, four mixers that all maps share, projections of the maps and of the positions.

    Args:
        out_channels: maps after the projection; published: 1024, 256, 64.
        out_rows: values per map after the projection; published: 4, 2, 2.
    """

    def __init__(self, out_channels: int = 1024, out_rows: int = 4, *, rngs: nnx.Rngs) -> None:
        self.dimension = out_channels * out_rows
        self.backbone = ResNet50("layer3", rngs=rngs)
        self.mix = nnx.List([FeatureMixer(_POSITIONS, rngs=rngs) for _ in range(4)])
        self.channel_proj = Linear(_CHANNELS, out_channels, rngs=rngs)
        self.row_proj = Linear(_POSITIONS, out_rows, rngs=rngs)

    preprocess = staticmethod(preprocess)

    def __call__(self, images: Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length, channels times rows, from preprocessed images of 320 x 320 px.

        Raises:
            ValueError: images of another size.
        """
        if images.shape[1:3] != IMAGE_SIZE[::-1]:
            height, width = images.shape[1:3]
            raise ValueError(f"MixVPR takes images of 320 x 320 px only, got {width} x {height}")
        return self.aggregate(self.backbone(images))

    def aggregate(self, maps: Float[Array, "batch 20 20 1024"]) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length from the backbone's maps."""
        maps = maps.reshape(len(maps), _POSITIONS, _CHANNELS).swapaxes(1, 2)
        for mixer in self.mix:
            maps = mixer(maps)
        # Both projections are linear and act on different axes. The rows, of which few remain, are projected first,
        # which saves a sixth of the time; the channels' bias is then summed over the rows' kernel.
        kernel = self.row_proj.kernel[...]
        bias = jnp.outer(kernel.sum(0), bias_of(self.channel_proj)) + bias_of(self.row_proj)[:, None]
        projected = matmul(matmul(maps, kernel).swapaxes(1, 2), self.channel_proj.kernel[...]) + bias[None]
        return of_unit_length(projected.swapaxes(1, 2).reshape(len(maps), self.dimension))
