"""LightGlue on the keypoints of two images, see `mfvpr.networks.lightglue`: attention and assignment, without Flax.

Masked keypoints do not affect other keypoints, and their own states are meaningless.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.core.types import Array, Features
from mfvpr.utils.numerics import masked

_PRECISION = jax.lax.Precision.HIGHEST  # also on hardware with less than float32
_EPSILON = 1e-5  # of the normalization

Tree = TypeVar("Tree")
Sides = tuple[Array, Array]  # of the two images
States = Float[Array, "keypoints width"]
Heads = Float[Array, "heads keypoints numbers"]  # equally many numbers of a state for each head


class Affine(NamedTuple):
    """Weights of a linear layer."""

    kernel: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    def __call__(self, values: Float[Array, "keypoints inputs"]) -> Float[Array, "keypoints outputs"]:
        return product(values, self.kernel) + self.bias[None]


class Block(NamedTuple):
    """Weights of one kind of attention."""

    inputs: Affine  # states -> queries, keys and values (or keys and values), each head by head
    hidden: Affine  # state and context, concatenated -> hidden values of the update, twice as many
    scale: Float[Array, " 2*width"]  # of their normalization
    shift: Float[Array, " 2*width"]
    update: Affine  # hidden values -> change of the state

    def update_states(self, states: States, context: Heads) -> States:
        """States after an update by a context."""
        together = jnp.concatenate([states, jnp.moveaxis(context, 0, 1).reshape(states.shape)], axis=1)
        hidden = self.hidden(together)
        centered = hidden - jnp.mean(hidden, axis=1, keepdims=True)
        variance = jnp.mean(centered * centered, axis=1, keepdims=True)
        hidden = centered * jax.lax.rsqrt(variance + _EPSILON) * self.scale[None] + self.shift[None]
        return states + self.update(jax.nn.gelu(hidden, approximate=False))


def within(
    block: Block, states: States, mask: Bool[Array, " keypoints"], rotation: Float[Array, "2 keypoints angles"]
) -> States:
    """States after self-attention of the keypoints of one image, masked by `mask`.

    The rotation encodes positions: cosines and sines of angles that turn pairs of numbers of a head, half a head apart.
    """
    queries, keys, values = _heads(block.inputs(states), 3, 2 * rotation.shape[2])
    cosine, sine = rotation[:, None]

    def rotate(numbers: Heads) -> Heads:
        first, second = jnp.split(numbers, 2, axis=-1)
        return jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)

    weights, total = _weights(product(rotate(queries), rotate(keys).swapaxes(1, 2)), mask, 2)
    return block.update_states(states, product(weights, values) / total)


def across(block: Block, states: Sides, masks: Sides, head: int) -> Sides:
    """States of both sides after cross-attention, with heads of `head` numbers.

    Weights over columns are not transposed, which would take several times longer on a CPU.
    """
    (keys0, values0), (keys1, values1) = (_heads(block.inputs(side), 2, head) for side in states)
    logits = product(keys0, keys1.swapaxes(1, 2))
    weights, total = _weights(logits, masks[1], 2)
    context0 = product(weights, values1) / total
    weights, total = _weights(logits, masks[0], 1)
    context1 = (product(values0.swapaxes(1, 2), weights) / total).swapaxes(1, 2)
    return block.update_states(states[0], context0), block.update_states(states[1], context1)


def product(left: Array, right: Array) -> Array:
    """Matrix product in full precision on every device."""
    return jnp.matmul(left, right, precision=_PRECISION)


def _heads(
    values: Float[Array, "keypoints _"], parts: int, head: int
) -> Float[Array, "{parts} heads keypoints {head}"]:
    """Split the numbers of each keypoint into parts and heads."""
    return jnp.moveaxis(values.reshape(len(values), parts, -1, head), 0, 2)


def _weights(
    logits: Float[Array, "heads rows columns"], mask: Bool[Array, " keypoints"], axis: int
) -> tuple[Float[Array, "heads rows columns"], Float[Array, "heads _ _"]]:
    """Numerators and denominators of a masked softmax along an axis, which keeps length 1."""
    real = jnp.expand_dims(mask, (0, 3 - axis))
    logits = jnp.where(real, logits, jnp.finfo(logits.dtype).min)  # -inf gives NaN if none is real
    weights = jnp.exp(logits - jnp.max(logits, axis=axis, keepdims=True))
    return weights, jnp.sum(weights, axis=axis, keepdims=True)


class PackedLayer(NamedTuple):
    """Weights of a layer; the projection is divided by the fourth root of the width."""

    within: Block
    across: Block
    projection: Affine
    matchability: Affine


class Packed(NamedTuple):
    """All weights; those of layers have a leading axis L. The last entry of `confidences` is unused padding."""

    input: Affine
    frequencies: Float[Array, "2 angles"]  # half as many angles as numbers of a head
    layers: PackedLayer
    confidences: Affine


def assignment(
    weights: Packed, features0: Features, features1: Features, *, depth_confidence: Array | float | None = None
) -> Float[Array, "keypoints0 keypoints1"]:
    """Logarithm of the confidence that two keypoints match, for all pairs of keypoints of two images.

    Args:
        weights: of the network.
        features0: features of one image, keypoints `[N0, 2]`; values of the padding are ignored.
        features1: features of the other image, keypoints `[N1, 2]`.
        depth_confidence: skip the remaining layers if more than this share of both images' keypoints is confident
            (published: 0.95). None = never.

    Returns:
        At most 0; -inf if either keypoint is padding, or its descriptor or position is not finite.
    """
    sides = _side(features0, weights.frequencies), _side(features1, weights.frequencies)
    masks = sides[0].mask, sides[1].mask
    num_layers, head = len(weights.layers.projection.bias), 2 * weights.frequencies.shape[1]

    def run_layer(progress: _Progress) -> _Progress:
        layer = _at(weights.layers, progress.layers)
        states0, states1 = (
            within(layer.within, states, side.mask, side.rotation)
            for states, side in zip(progress.states, sides, strict=True)
        )
        states = across(layer.across, (states0, states1), masks, head)
        done = jnp.zeros((), bool)
        if depth_confidence is not None:
            threshold = 0.8 + 0.1 * jnp.exp(-4 * progress.layers.astype(states[0].dtype) / num_layers)
            confidence = _at(weights.confidences, progress.layers)
            unsure = [
                jnp.sum(mask & (jax.nn.sigmoid(confidence(side)[:, 0]) < threshold))
                for side, mask in zip(states, masks, strict=True)
            ]
            total = jnp.maximum(jnp.sum(masks[0]) + jnp.sum(masks[1]), 1)
            done = 1 - (unsure[0] + unsure[1]) / total > depth_confidence
        return _Progress(progress.layers + 1, states, done)

    def is_running(progress: _Progress) -> Array:
        return (progress.layers < num_layers) & ~progress.done

    inputs = weights.input(sides[0].descriptors), weights.input(sides[1].descriptors)
    start = _Progress(jnp.zeros((), jnp.int32), inputs, jnp.zeros((), bool))
    layers, (states0, states1), _ = jax.lax.while_loop(is_running, run_layer, start)

    layer = _at(weights.layers, layers - 1)
    similarity = product(layer.projection(states0), layer.projection(states1).T)
    real = masks[0][:, None] & masks[1][None]
    similarity = jnp.where(real, similarity, jnp.finfo(similarity.dtype).min)  # -inf gives NaN if none is real
    matchable0, matchable1 = (jax.nn.log_sigmoid(layer.matchability(states)[:, 0]) for states in (states0, states1))
    both = jax.nn.log_softmax(similarity, axis=0) + jax.nn.log_softmax(similarity, axis=1)
    return masked(both + matchable0[:, None] + matchable1[None], real, -jnp.inf)


class _Side(NamedTuple):
    """Keypoints of one image."""

    descriptors: Float[Array, "keypoints dimensions"]
    mask: Bool[Array, " keypoints"]
    rotation: Float[Array, "2 keypoints angles"]


def _side(features: Features, frequencies: Float[Array, "2 angles"]) -> _Side:
    """Mask features with values that are not finite, and set masked values to zero.

    The rotation is by positions in units of half of the image's longer side, from its center.
    """
    finite = [jnp.all(jnp.isfinite(values), axis=-1) for values in (features.descriptors, features.keypoints)]
    mask, size = features.mask & finite[0] & finite[1], features.image_size
    positions = (masked(features.keypoints, mask) - size[None] / 2) / (jnp.max(size) / 2)
    angles = product(positions, frequencies)
    return _Side(masked(features.descriptors, mask), mask, jnp.stack([jnp.cos(angles), jnp.sin(angles)]))


class _Progress(NamedTuple):
    """States of both sides after some layers; `done` skips the remaining layers."""

    layers: Array
    states: tuple[Array, Array]
    done: Array


def _at(stacked: Tree, layer: Array) -> Tree:
    return jax.tree.map(lambda leaf: leaf[layer], stacked)
