"""Global descriptors from a backbone's map: MixVPR, NetVLAD, and generalized means.

MixVPR (Ali-bey et al., WACV 2023) mixes maps by small perceptrons. NetVLAD (Arandjelovic et al., CVPR 2016) sums the
differences between a map's vectors and cluster centers. Patch-NetVLAD (Hausler et al., CVPR 2021) also sums over each
square of the map, which gives descriptors of patches. Generalized means (Radenovic et al., TPAMI 2019) are those of
CosPlace (CVPR 2022).
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array
from mfvpr.networks import layers
from mfvpr.networks.backbones import ResNet50, Vgg16, require_position

IMAGE_SIZE = (320, 320)  # px, width and height, of MixVPR; the mixers' weights depend on it
_MIXED_CHANNELS, _POSITIONS = 1024, 20 * 20  # of its backbone's maps
CHANNELS = 512  # of VGG16's conv5_3
Order = Literal["clusters", "channels"]  # the outer axis of a descriptor

_BACKBONES = {"vgg16": (Vgg16, 512), "resnet50": (ResNet50, 2048)}  # with the channels of their maps


class Statistic(nnx.Variable):
    """Statistic of a network's training images, which is no parameter."""


class NetVlad(nnx.Module):
    """V_k = sum_p a_k(x_p) (x_p - c_k), x of unit length, a the softmax over k of a linear map of x.

    Each V_k is scaled to unit length, then all together.

    Args:
        clusters: K.
        order: "clusters" gives V as `[K, D]`, as PyTorch's codes, "channels" as `[D, K]`, as the original.
    """

    def __init__(self, clusters: int, order: Order = "clusters", *, rngs: nnx.Rngs) -> None:
        self.assignment = layers.Linear(CHANNELS, clusters, use_bias=False, rngs=rngs)
        self.centers = nnx.Param(jnp.zeros((clusters, CHANNELS), jnp.float32))
        self.order = order

    def __call__(self, maps: Float[Array, "batch rows columns channels"]) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length."""
        x = layers.of_unit_length(maps.reshape(len(maps), -1, CHANNELS))
        share = nnx.softmax(self.assignment(x))
        sums = jnp.einsum("bpk,bpd->bkd", share, x, precision=layers.PRECISION)
        return self._descriptors(sums - jnp.sum(share, axis=1)[..., None] * self.centers[...][None])

    def patches(
        self, maps: Float[Array, "batch rows columns channels"], size: int
    ) -> Float[Array, "batch (rows-{size}+1)*(columns-{size}+1) dimensions"]:
        """Descriptors of all squares of `size` positions, by rows."""
        x = layers.of_unit_length(maps)
        residuals = nnx.softmax(self.assignment(x))[..., None] * (x[..., None, :] - self.centers[...][None, None, None])
        sums = residuals
        for axis in (1, 2):  # a product with ones and zeros; differences of cumulative sums round more
            inside = np.subtract.outer(np.arange(sums.shape[axis]), np.arange(sums.shape[axis] - size + 1))
            band = jnp.asarray((inside >= 0) & (inside < size), sums.dtype)
            sums = jnp.moveaxis(jnp.tensordot(band, sums, axes=(0, axis), precision=layers.PRECISION), 0, axis)
        return self._descriptors(sums.reshape(len(maps), -1, *sums.shape[3:]))

    def _descriptors(self, sums: Float[Array, "*batch clusters channels"]) -> Float[Array, "*batch dimensions"]:
        sums = layers.of_unit_length(sums)
        ordered = sums if self.order == "clusters" else sums.swapaxes(-1, -2)
        return layers.of_unit_length(ordered.reshape(*sums.shape[:-2], -1))


class VggNetVlad(nnx.Module):
    """VGG16 to `conv5_3`, before its ReLU, NetVLAD, and a projection to whitened principal components.

    Args:
        clusters: of NetVLAD; 16 or 64 are published.
        outputs: numbers of a descriptor; None = NetVLAD's, without projection.
        original: preprocess as the original code, which subtracts the average image of its weights, and order
            descriptors by channels; otherwise as PyTorch's networks.
    """

    def __init__(
        self, clusters: int = 64, outputs: int | None = 4096, *, original: bool = False, rngs: nnx.Rngs
    ) -> None:
        self.vgg = Vgg16(rngs=rngs)
        self.pool = NetVlad(clusters, "channels" if original else "clusters", rngs=rngs)
        self.dimension = outputs or clusters * CHANNELS
        self.has_components = outputs is not None
        if outputs is not None:
            self.projection = layers.Linear(clusters * CHANNELS, outputs, rngs=rngs)
        self.original = original
        if original:
            self.average = Statistic(jnp.zeros(3, jnp.float32))

    require = staticmethod(require_position)

    def preprocess(self, images: layers.Pixels) -> layers.Images:
        """RGB images, 0 .. 255, uint8 or float32 -> inputs of the network, float32."""
        if self.original:
            return images.astype(jnp.float32) - self.average[...][None, None, None]
        return layers.preprocess(images)

    def __call__(self, images: layers.Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length of preprocessed images."""
        return self._project(self.pool(self.vgg(images)))

    def with_patches(
        self, images: layers.Images, sizes: tuple[int, ...]
    ) -> tuple[Float[Array, "batch dimensions"], tuple[Float[Array, "batch patches dimensions"], ...]]:
        """Descriptors of images, and for each size those of all patches, by rows."""
        maps = self.vgg(images)
        patches = (self.pool.patches(maps, size) for size in sizes)
        return self._project(self.pool(maps)), tuple(map(self._project, patches))

    def _project(self, descriptors: Float[Array, "*batch _"]) -> Float[Array, "*batch dimensions"]:
        return layers.of_unit_length(self.projection(descriptors)) if self.has_components else descriptors


class Gem(nnx.Module):
    """Generalized mean of a backbone's last map, of unit length at each position, and a projection to `outputs`.

    The backbone is VGG16 to `conv5_3`, before its ReLU, or ResNet-50 without its classifier.
    """

    def __init__(
        self, backbone: Literal["vgg16", "resnet50"] = "resnet50", outputs: int = 2048, *, rngs: nnx.Rngs
    ) -> None:
        backbone_class, channels = _BACKBONES[backbone]
        self.backbone = backbone_class(rngs=rngs)
        self.pool = layers.GeneralizedMean()
        self.projection = layers.Linear(channels, outputs, rngs=rngs)
        self.dimension = outputs
        self.has_components = False

    require = staticmethod(require_position)
    preprocess = staticmethod(layers.preprocess)

    def __call__(self, images: layers.Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length of preprocessed images."""
        return layers.of_unit_length(self.projection(self.pool(layers.of_unit_length(self.backbone(images)))))


class FeatureMixer(nnx.Module):
    """Perceptron on the positions of each map, with a shortcut: LayerNorm, Linear, ReLU, Linear."""

    def __init__(self, size: int, *, rngs: nnx.Rngs) -> None:
        self.norm = layers.LayerNorm(size, epsilon=1e-5, rngs=rngs)  # published; a smaller one changes faint maps
        self.linear1, self.linear2 = (layers.Linear(size, size, rngs=rngs) for _ in range(2))

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
        self.channel_proj = layers.Linear(_MIXED_CHANNELS, out_channels, rngs=rngs)
        self.row_proj = layers.Linear(_POSITIONS, out_rows, rngs=rngs)

    preprocess = staticmethod(layers.preprocess)

    def __call__(self, images: layers.Images) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length, channels times rows, from preprocessed images of 320 x 320 px."""
        if images.shape[1:3] != IMAGE_SIZE[::-1]:
            got = f"{images.shape[2]} x {images.shape[1]} px; resize them"
            raise ValueError(f"MixVPR: expected images of 320 x 320 px, got {got}")
        return self.aggregate(self.backbone(images))

    def aggregate(self, maps: Float[Array, "batch 20 20 1024"]) -> Float[Array, "batch dimensions"]:
        """Descriptors of unit length from the backbone's maps."""
        maps = maps.reshape(len(maps), _POSITIONS, _MIXED_CHANNELS).swapaxes(1, 2)
        for mixer in self.mix:
            maps = mixer(maps)
        # Both projections are linear and act on different axes. The rows, of which few remain, are projected first,
        # which saves a sixth of the time; the channels' bias is then summed over the rows' kernel.
        kernel = self.row_proj.kernel[...]
        bias = jnp.outer(kernel.sum(0), layers.bias_of(self.channel_proj)) + layers.bias_of(self.row_proj)[:, None]
        by_row = layers.matmul(maps, kernel).swapaxes(1, 2)
        projected = layers.matmul(by_row, self.channel_proj.kernel[...]) + bias[None]
        return layers.of_unit_length(projected.swapaxes(1, 2).reshape(len(maps), self.dimension))
