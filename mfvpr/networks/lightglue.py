"""LightGlue (Lindenberger et al., ICCV 2023): which keypoints of two images are the same points, by attention.

Each layer lets the keypoints of an image see each other, then those of the other image. After every layer the
assignment of all pairs of keypoints may be read. The module holds the published weights; `packed` lays them out, once,
for `lightglue_assignment.assignment`, which is for one pair of images.
"""

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.networks.lightglue_assignment import Packed, PackedLayer
from mfvpr.networks.lightglue_attention import Affine, Block, product


class FeedForward(nnx.Module):
    """Of a keypoint's state and the message for it, side by side: Linear, LayerNorm, GELU, Linear."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = nnx.Linear(2 * width, 2 * width, rngs=rngs)
        self.norm = nnx.LayerNorm(2 * width, rngs=rngs)
        self.update = nnx.Linear(2 * width, width, rngs=rngs)


class SelfAttention(nnx.Module):
    """Within an image. Outputs of `qkv` are numbered by head, number of the head, and query, key or value."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.qkv = nnx.Linear(width, 3 * width, rngs=rngs)
        self.message = nnx.Linear(width, width, rngs=rngs)
        self.feed_forward = FeedForward(width, rngs=rngs)


class CrossAttention(nnx.Module):
    """Between the images: one side's queries are the other's keys."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.key = nnx.Linear(width, width, rngs=rngs)
        self.value = nnx.Linear(width, width, rngs=rngs)
        self.message = nnx.Linear(width, width, rngs=rngs)
        self.feed_forward = FeedForward(width, rngs=rngs)


class Layer(nnx.Module):
    """Both kinds of attention, and what reads the assignment after them."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.self_attention = SelfAttention(width, rngs=rngs)
        self.cross_attention = CrossAttention(width, rngs=rngs)
        self.projection = nnx.Linear(width, width, rngs=rngs)
        self.matchability = nnx.Linear(width, 1, rngs=rngs)


class LightGlue(nnx.Module):
    """The published weights, or others of this form.

    Args:
        inputs: D, numbers of a descriptor.
        width: of a keypoint's state.
        num_layers: L.
        num_heads: which share the width.
    """

    def __init__(
        self, inputs: int = 128, width: int = 256, num_layers: int = 9, num_heads: int = 4, *, rngs: nnx.Rngs
    ) -> None:
        self.input = nnx.Linear(inputs, width, rngs=rngs)
        self.position = nnx.Linear(2, width // num_heads // 2, use_bias=False, rngs=rngs)
        self.layers = nnx.List([Layer(width, rngs=rngs) for _ in range(num_layers)])
        self.confidences = nnx.List([nnx.Linear(width, 1, rngs=rngs) for _ in range(num_layers - 1)])

    def packed(self) -> Packed:
        """The weights as `assignment` takes them."""
        layers = [_packed_layer(layer, 2 * self.position.out_features) for layer in self.layers]
        confidences = [_affine(confidence) for confidence in self.confidences]
        return Packed(
            input=_affine(self.input),
            frequencies=self.position.kernel[...],
            layers=jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers),
            confidences=jax.tree.map(lambda *leaves: jnp.stack([*leaves, leaves[-1]]), *confidences),
        )


def _affine(linear: nnx.Linear) -> Affine:
    assert linear.bias is not None  # Flax's own type allows for it
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
    """The message is linear, and so is what the feed-forward does with it first: one product for both."""
    message, feed_forward = _affine(attention.message), attention.feed_forward
    hidden, scale, shift = _affine(feed_forward.hidden), feed_forward.norm.scale, feed_forward.norm.bias
    assert scale is not None  # as of a bias
    assert shift is not None
    own, others = jnp.split(hidden.kernel, 2)
    kernel = jnp.concatenate([own, product(message.kernel, others)])
    bias = hidden.bias + product(message.bias, others)
    return Block(inputs, Affine(kernel, bias), scale[...], shift[...], _affine(feed_forward.update))


def _self_inputs(attention: SelfAttention, head: int) -> Affine:
    """Queries (divided by the root of a head's width), keys, values. Neighbors turn together: now half a head apart."""

    def in_order(outputs: Array) -> Array:
        queries, keys, values = jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], -1, head, 3), -1, 0)  # [..., H, d]
        parts = [_apart(queries) / head**0.5, _apart(keys), values]
        return jnp.stack(parts, axis=-3).reshape(outputs.shape)

    return Affine(*map(in_order, _affine(attention.qkv)))


def _apart(values: Array) -> Array:
    """The even entries of the last axis, then the odd ones."""
    return jnp.concatenate([values[..., ::2], values[..., 1::2]], axis=-1)


def _cross_inputs(attention: CrossAttention, head: int) -> Affine:
    """Keys (divided by the fourth root of a head's width, as they meet each other), values."""
    keys, values = _affine(attention.key), _affine(attention.value)
    return Affine(
        *(jnp.concatenate([key / head**0.25, value], axis=-1) for key, value in zip(keys, values, strict=True))
    )
