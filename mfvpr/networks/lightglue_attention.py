"""LightGlue's two kinds of attention, on the states of the keypoints of one pair of images.

States are `[N, D]`, of H heads with d = D / H numbers each. Masked keypoints do not affect other keypoints, and their
own states are meaningless.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

_PRECISION = jax.lax.Precision.HIGHEST  # also on hardware with less than float32
_EPSILON = 1e-5  # of the normalization

Sides = tuple[Array, Array]  # of the two images


class Affine(NamedTuple):
    """A kernel `[inputs, outputs]` and a bias `[outputs]`."""

    kernel: Array
    bias: Array

    def __call__(self, values: Array) -> Array:
        """`[N, inputs]` -> `[N, outputs]`."""
        return product(values, self.kernel) + self.bias[None]


class Block(NamedTuple):
    """Weights of one kind of attention.

    Attributes:
        inputs: states -> queries, keys and values (or keys and values), each head by head.
        hidden: state and context, concatenated -> hidden values of the update, `[2 D, 2 D]`.
        scale: `[2 D]` of their normalization.
        shift: `[2 D]` of their normalization.
        update: hidden values -> change of the state.
    """

    inputs: Affine
    hidden: Affine
    scale: Array
    shift: Array
    update: Affine

    def update_states(self, states: Array, context: Array) -> Array:
        """States `[N, D]` after an update by a context `[H, N, d]`."""
        together = jnp.concatenate([states, jnp.moveaxis(context, 0, 1).reshape(states.shape)], axis=1)
        hidden = self.hidden(together)
        centered = hidden - jnp.mean(hidden, axis=1, keepdims=True)
        variance = jnp.mean(centered * centered, axis=1, keepdims=True)
        hidden = centered * jax.lax.rsqrt(variance + _EPSILON) * self.scale[None] + self.shift[None]
        return states + self.update(jax.nn.gelu(hidden, approximate=False))


class Rotation(NamedTuple):
    """Rotary position encoding: cosines and sines `[N, d / 2]` of angles that turn pairs of numbers of a head."""

    cosine: Array
    sine: Array

    @classmethod
    def of(cls, positions: Array, frequencies: Array) -> "Rotation":
        """Rotation for positions `[N, 2]` and frequencies `[2, d / 2]`."""
        angles = product(positions, frequencies)
        return cls(jnp.cos(angles), jnp.sin(angles))

    def __call__(self, values: Array) -> Array:
        """Turn `[H, N, d]`; the first half of each head is paired with the second."""
        first, second = jnp.split(values, 2, axis=-1)
        cosine, sine = self.cosine[None], self.sine[None]
        return jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)


def within(block: Block, states: Array, mask: Array, rotation: Rotation) -> Array:
    """States `[N, D]` after self-attention of the keypoints of one image, masked by `mask` `[N]`."""
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


def _heads(values: Array, parts: int, head: int) -> Array:
    """`[N, parts * H * d]` -> `[parts, H, N, d]`."""
    return jnp.moveaxis(values.reshape(len(values), parts, -1, head), 0, 2)


def _weights(logits: Array, mask: Array, axis: int) -> tuple[Array, Array]:
    """Numerators and denominators of a masked softmax of `[H, N, M]` along an axis, which keeps length 1."""
    real = jnp.expand_dims(mask, (0, 3 - axis))
    logits = jnp.where(real, logits, jnp.finfo(logits.dtype).min)  # -inf gives NaN if none is real
    weights = jnp.exp(logits - jnp.max(logits, axis=axis, keepdims=True))
    return weights, jnp.sum(weights, axis=axis, keepdims=True)
