"""LightGlue (Lindenberger et al., ICCV 2023): which keypoints of two images are the same points, by attention.

Each layer lets the keypoints of an image see each other, then those of the other image. After every layer the
assignment of all pairs of keypoints may be read. The module holds the published weights; `packed` lays them out, once,
for `assignment`, which is for one pair of images.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from mfvpr.models.lightglue_attention import Affine, Block, Rotation, across, product, within
from mfvpr.numerics import masked
from mfvpr.types import Features

Tree = TypeVar("Tree")


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

    def packed(self) -> "Packed":
        """The weights as `assignment` takes them."""
        layers = [_packed_layer(layer, 2 * self.position.out_features) for layer in self.layers]
        confidences = [_affine(confidence) for confidence in self.confidences]
        return Packed(
            input=_affine(self.input),
            frequencies=self.position.kernel[...],
            layers=jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers),
            confidences=jax.tree.map(lambda *leaves: jnp.stack([*leaves, leaves[-1]]), *confidences),
        )


class PackedLayer(NamedTuple):
    """What a layer computes with; the projection is divided by the fourth root of the width."""

    within: Block
    across: Block
    projection: Affine
    matchability: Affine


class Packed(NamedTuple):
    """All weights, those of the layers with a leading axis L; the last of the confidences fills up and is not used."""

    input: Affine
    frequencies: Array  # [2, d / 2], d numbers of a head
    layers: PackedLayer
    confidences: Affine


def assignment(
    weights: Packed, features0: Features, features1: Features, *, depth_confidence: Array | float | None = None
) -> Array:
    """How surely each keypoint of one image is the same point as each of the other, as a logarithm.

    Args:
        weights: of the network.
        features0: of one image, keypoints `[N0, 2]`; padding may hold anything.
        features1: of the other, keypoints `[N1, 2]`.
        depth_confidence: where after some layer more than this share of both images' keypoints is sure, the layers
            behind it are left out (published: 0.95). None = never.

    Returns:
        `[N0, N1]`, at most 0; -inf where either keypoint is padding, or its descriptor or position is not finite.
    """
    sides = _finite(features0), _finite(features1)
    masks = [side.mask for side in sides]
    turns = [Rotation.of(_normalized(side), weights.frequencies) for side in sides]
    num_layers, head = len(weights.layers.projection.bias), 2 * weights.frequencies.shape[1]

    def after_another(progress: _Progress) -> _Progress:
        layer = _at(weights.layers, progress.layers)
        seen = [within(layer.within, *side) for side in zip(progress.states, masks, turns, strict=True)]
        states = across(layer.across, (seen[0], seen[1]), (masks[0], masks[1]), head)
        done = jnp.zeros((), bool)
        if depth_confidence is not None:
            threshold = 0.8 + 0.1 * jnp.exp(-4 * progress.layers.astype(states[0].dtype) / num_layers)
            done = _share_sure(_at(weights.confidences, progress.layers), states, masks, threshold) > depth_confidence
        return _Progress(progress.layers + 1, states, done)

    def is_more(progress: _Progress) -> Array:
        return (progress.layers < num_layers) & ~progress.done

    inputs = weights.input(sides[0].descriptors), weights.input(sides[1].descriptors)
    start = _Progress(jnp.zeros((), jnp.int32), inputs, jnp.zeros((), bool))
    layers, states, _ = jax.lax.while_loop(is_more, after_another, start)
    return _read(_at(weights.layers, layers - 1), *states, *masks)


class _Progress(NamedTuple):
    """How many layers both sides' states have gone through, and whether the others are left out."""

    layers: Array
    states: tuple[Array, Array]
    done: Array


def _at(stacked: Tree, layer: Array) -> Tree:
    return jax.tree.map(lambda leaf: leaf[layer], stacked)


def _share_sure(confidence: Affine, states: Sequence[Array], masks: Sequence[Array], threshold: Array) -> Array:
    """Of the keypoints of both sides."""
    unsure = [
        jnp.sum(mask & (jax.nn.sigmoid(confidence(side)[:, 0]) < threshold))
        for side, mask in zip(states, masks, strict=True)
    ]
    return 1 - sum(unsure[1:], start=unsure[0]) / jnp.maximum(jnp.sum(masks[0]) + jnp.sum(masks[1]), 1)


def _read(layer: PackedLayer, states0: Array, states1: Array, mask0: Array, mask1: Array) -> Array:
    """The assignment after a layer."""
    similarity = product(layer.projection(states0), layer.projection(states1).T)
    real = mask0[:, None] & mask1[None]
    similarity = jnp.where(real, similarity, jnp.finfo(similarity.dtype).min)  # -inf gives NaN where none is real
    matchable0, matchable1 = (jax.nn.log_sigmoid(layer.matchability(states)[:, 0]) for states in (states0, states1))
    both = jax.nn.log_softmax(similarity, axis=0) + jax.nn.log_softmax(similarity, axis=1)
    return masked(both + matchable0[:, None] + matchable1[None], real, -jnp.inf)


def _finite(features: Features) -> Features:
    """Without what is not finite, and zeros in the padding."""
    finite = [jnp.all(jnp.isfinite(values), axis=-1) for values in (features.descriptors, features.keypoints)]
    mask = features.mask & finite[0] & finite[1]
    return Features(
        masked(features.keypoints, mask), masked(features.descriptors, mask), features.scores, mask, features.image_size
    )


def _normalized(features: Features) -> Array:
    """Keypoints in units of half of the image's longer side, from its center."""
    size = features.image_size
    return (features.keypoints - size[None] / 2) / (jnp.max(size) / 2)


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
