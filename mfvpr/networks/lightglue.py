"""LightGlue (Lindenberger et al., ICCV 2023): match the keypoints of two images by attention.

Each layer has self-attention among the keypoints of an image, then cross-attention to those of the other image. An
assignment of the keypoints can be computed after each layer. The module has the published weights; `pack` arranges
them once for `lightglue_assignment.assignment`, which matches one pair of images.
"""

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.networks.layers import bias_of
from mfvpr.networks.lightglue_assignment import Affine, Block, Packed, PackedLayer, product


class Attention(nnx.Module):
    """One kind of attention: linear maps of a keypoint's state, then the update by the message of other keypoints.

    Within an image, one map gives queries, keys and values, with the axes head, number, and query, key or value. Across
    images, one map gives keys, the queries of the other image, and one values. The update is Linear, LayerNorm, GELU,
    Linear on state and message, concatenated.
    """

    def __init__(self, width: int, inputs: tuple[int, ...], *, rngs: nnx.Rngs) -> None:
        self.inputs = nnx.List([nnx.Linear(width, parts * width, rngs=rngs) for parts in inputs])
        self.message = nnx.Linear(width, width, rngs=rngs)
        self.hidden = nnx.Linear(2 * width, 2 * width, rngs=rngs)
        self.norm = nnx.LayerNorm(2 * width, rngs=rngs)
        self.update = nnx.Linear(2 * width, width, rngs=rngs)


class Layer(nnx.Module):
    """Both kinds of attention, and the linear maps of the assignment after them."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.within, self.across = Attention(width, (3,), rngs=rngs), Attention(width, (1, 1), rngs=rngs)
        self.projection = nnx.Linear(width, width, rngs=rngs)
        self.matchability = nnx.Linear(width, 1, rngs=rngs)


class LightGlue(nnx.Module):
    """LightGlue's weights.

    Args:
        inputs: D, numbers of a descriptor.
        width: numbers of a keypoint's state.
        num_layers: L.
        num_heads: heads of the attention, which share the width.
    """

    def __init__(
        self, inputs: int = 128, width: int = 256, num_layers: int = 9, num_heads: int = 4, *, rngs: nnx.Rngs
    ) -> None:
        self.input = nnx.Linear(inputs, width, rngs=rngs)
        self.position = nnx.Linear(2, width // num_heads // 2, use_bias=False, rngs=rngs)
        self.layers = nnx.List([Layer(width, rngs=rngs) for _ in range(num_layers)])
        self.confidences = nnx.List([nnx.Linear(width, 1, rngs=rngs) for _ in range(num_layers - 1)])

    def pack(self) -> Packed:
        """Weights for `assignment`."""
        layers = [_pack_layer(layer, 2 * self.position.out_features) for layer in self.layers]
        confidences = [_affine(confidence) for confidence in self.confidences]
        return Packed(
            input=_affine(self.input),
            frequencies=self.position.kernel[...],
            layers=jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers),
            confidences=jax.tree.map(lambda *leaves: jnp.stack([*leaves, leaves[-1]]), *confidences),
        )


def _affine(linear: nnx.Linear) -> Affine:
    return Affine(linear.kernel[...], bias_of(linear))


def _pack_layer(layer: Layer, head: int) -> PackedLayer:
    """Weights of a layer with heads of `head` numbers.

    Queries are divided by the square root of `head`, and keys that meet keys by its fourth root. The rotation turns
    pairs of numbers: neighbors in the published weights, half a head apart here.
    """

    def separate(values: Array) -> Array:
        return jnp.concatenate([values[..., ::2], values[..., 1::2]], axis=-1)

    def arrange(outputs: Array) -> Array:
        queries, keys, values = jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], -1, head, 3), -1, 0)  # [..., H, d]
        parts = [separate(queries) / head**0.5, separate(keys), values]
        return jnp.stack(parts, axis=-3).reshape(outputs.shape)

    within = Affine(*map(arrange, _affine(layer.within.inputs[0])))
    keys, values = (_affine(linear) for linear in layer.across.inputs)
    sides = zip(keys, values, strict=True)  # kernels, then biases
    across = Affine(*(jnp.concatenate([key / head**0.25, value], axis=-1) for key, value in sides))
    projection, root = _affine(layer.projection), layer.projection.out_features**0.25
    return PackedLayer(
        within=_pack_block(layer.within, within),
        across=_pack_block(layer.across, across),
        projection=Affine(projection.kernel / root, projection.bias / root),
        matchability=_affine(layer.matchability),
    )


def _pack_block(attention: Attention, inputs: Affine) -> Block:
    """Weights of a block. The message and the first layer of the update are linear, so one product does both."""
    message, hidden = _affine(attention.message), _affine(attention.hidden)
    scale, shift = attention.norm.scale, attention.norm.bias
    assert scale is not None
    assert shift is not None
    state_kernel, message_kernel = jnp.split(hidden.kernel, 2)
    kernel = jnp.concatenate([state_kernel, product(message.kernel, message_kernel)])
    bias = hidden.bias + product(message.bias, message_kernel)
    return Block(inputs, Affine(kernel, bias), scale[...], shift[...], _affine(attention.update))
