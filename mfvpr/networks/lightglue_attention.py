"""LightGlue's two kinds of attention, on the states of the keypoints of one pair of images.

Masked keypoints do not affect other keypoints, and their own states are meaningless.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mfvpr.types import Array

_PRECISION = jax.lax.Precision.HIGHEST  # also on hardware with less than float32
_EPSILON = 1e-5  # of the normalization

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
    """Weights of one kind of attention.

    Attributes:
        inputs: states -> queries, keys and values (or keys and values), each head by head.
        hidden: state and context, concatenated -> hidden values of the update, twice as many.
        scale: of their normalization.
        shift: of their normalization.
        update: hidden values -> change of the state.
    """

    inputs: Affine
    hidden: Affine
    scale: Float[Array, " 2*width"]
    shift: Float[Array, " 2*width"]
    update: Affine

    def update_states(self, states: States, context: Heads) -> States:
        """States after an update by a context."""
        together = jnp.concatenate([states, jnp.moveaxis(context, 0, 1).reshape(states.shape)], axis=1)
        hidden = self.hidden(together)
        centered = hidden - jnp.mean(hidden, axis=1, keepdims=True)
        variance = jnp.mean(centered * centered, axis=1, keepdims=True)
        hidden = centered * jax.lax.rsqrt(variance + _EPSILON) * self.scale[None] + self.shift[None]
        return states + self.update(jax.nn.gelu(hidden, approximate=False))


class Rotation(NamedTuple):
    """Rotary position encoding: cosines and sines of angles that turn pairs of numbers of a head."""

    cosine: Float[Array, "keypoints angles"]
    sine: Float[Array, "keypoints angles"]

    @classmethod
    def of(cls, positions: Float[Array, "keypoints 2"], frequencies: Float[Array, "2 angles"]) -> "Rotation":
        """Rotation for positions and frequencies."""
        angles = product(positions, frequencies)
        return cls(jnp.cos(angles), jnp.sin(angles))

    def __call__(self, values: Heads) -> Heads:
        """Turn values; the first half of each head is paired with the second."""
        first, second = jnp.split(values, 2, axis=-1)
        cosine, sine = self.cosine[None], self.sine[None]
        return jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)


def within(block: Block, states: States, mask: Bool[Array, " keypoints"], rotation: Rotation) -> States:
    """States after self-attention of the keypoints of one image, masked by `mask`."""
    queries, keys, values = _heads(block.inputs(states), 3, 2 * rotation.cosine.shape[1])
    weights, total = _weights(product(rotation(queries), rotation(keys).swapaxes(1, 2)), mask, 2)
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
