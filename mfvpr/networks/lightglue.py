"""LightGlue (Lindenberger et al., ICCV 2023): match the keypoints of two images by attention.

Each layer has self-attention among the keypoints of an image, then cross-attention to those of the other image. An
assignment of the keypoints can be computed after each layer. The module has the published weights; `pack` arranges
them once for `lightglue_assignment.assignment`, which matches one pair of images.
"""

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.networks.lightglue_assignment import Affine, Block, Packed, PackedLayer, product


class FeedForward(nnx.Module):
    """Linear, LayerNorm, GELU, Linear on a keypoint's state and its message, concatenated."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = nnx.Linear(2 * width, 2 * width, rngs=rngs)
        self.norm = nnx.LayerNorm(2 * width, rngs=rngs)
        self.update = nnx.Linear(2 * width, width, rngs=rngs)


class SelfAttention(nnx.Module):
    """Attention within an image. The outputs of `qkv` have the axes head, number, and query, key or value."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.qkv = nnx.Linear(width, 3 * width, rngs=rngs)
        self.message = nnx.Linear(width, width, rngs=rngs)
        self.feed_forward = FeedForward(width, rngs=rngs)


class CrossAttention(nnx.Module):
    """Attention between the images: the queries of one image are the keys of the other."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.key = nnx.Linear(width, width, rngs=rngs)
        self.value = nnx.Linear(width, width, rngs=rngs)
        self.message = nnx.Linear(width, width, rngs=rngs)
        self.feed_forward = FeedForward(width, rngs=rngs)


class Layer(nnx.Module):
    """Both kinds of attention, and the linear maps of the assignment after them."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.self_attention = SelfAttention(width, rngs=rngs)
        self.cross_attention = CrossAttention(width, rngs=rngs)
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
        layers = [_packed_layer(layer, 2 * self.position.out_features) for layer in self.layers]
        confidences = [_affine(confidence) for confidence in self.confidences]
        return Packed(
            input=_affine(self.input),
            frequencies=self.position.kernel[...],
            layers=jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers),
            confidences=jax.tree.map(lambda *leaves: jnp.stack([*leaves, leaves[-1]]), *confidences),
        )


def _affine(linear: nnx.Linear) -> Affine:
    assert linear.bias is not None  # Flax's annotation allows None
    return Affine(linear.kernel[...], linear.bias[...])


def _packed_layer(layer: Layer, head: int) -> PackedLayer:
    projection, root = _affine(layer.projection), layer.projection.out_features**0.25
    return PackedLayer(
        within=_packed_block(layer.self_attention, _self_inputs(layer.self_attention, head)),
        across=_packed_block(layer.cross_attention, _cross_inputs(layer.cross_attention, head)),
        projection=Affine(projection.kernel / root, projection.bias / root),
        matchability=_affine(layer.matchability),
    )


def _packed_block(attention: SelfAttention | CrossAttention, inputs: Affine) -> Block:
    """Weights of a block. The message and the first layer of the feed-forward are linear, so one product does both."""
    message, feed_forward = _affine(attention.message), attention.feed_forward
    hidden, scale, shift = _affine(feed_forward.hidden), feed_forward.norm.scale, feed_forward.norm.bias
    assert scale is not None
    assert shift is not None
    state_kernel, message_kernel = jnp.split(hidden.kernel, 2)
    kernel = jnp.concatenate([state_kernel, product(message.kernel, message_kernel)])
    bias = hidden.bias + product(message.bias, message_kernel)
    return Block(inputs, Affine(kernel, bias), scale[...], shift[...], _affine(feed_forward.update))


def _self_inputs(attention: SelfAttention, head: int) -> Affine:
    """Queries (divided by the square root of a head's width), keys and values.

    The rotation turns pairs of numbers: neighbors in the published weights, half a head apart here.
    """

    def arrange(outputs: Array) -> Array:
        queries, keys, values = jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], -1, head, 3), -1, 0)  # [..., H, d]
        parts = [_separate(queries) / head**0.5, _separate(keys), values]
        return jnp.stack(parts, axis=-3).reshape(outputs.shape)

    return Affine(*map(arrange, _affine(attention.qkv)))


def _separate(values: Array) -> Array:
    """Even entries of the last axis, then the odd ones."""
    return jnp.concatenate([values[..., ::2], values[..., 1::2]], axis=-1)


def _cross_inputs(attention: CrossAttention, head: int) -> Affine:
    """Keys (divided by the fourth root of a head's width, since keys meet keys) and values."""
    keys, values = _affine(attention.key), _affine(attention.value)
    return Affine(
        *(jnp.concatenate([key / head**0.25, value], axis=-1) for key, value in zip(keys, values, strict=True))
    )
