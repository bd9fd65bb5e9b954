"""LightGlue (Lindenberger et al., ICCV 2023): match the keypoints of two images by attention.

Each layer has self-attention among the keypoints of an image, then cross-attention to those of the other image. An
assignment of the keypoints can be computed after each layer. `LightGlue` has the published weights; `pack` arranges
them once for `assignment`, which matches one pair of images.

Masked keypoints do not affect other keypoints, and their own states are meaningless.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float

from mfvpr.core.types import Array, Features
from mfvpr.networks.layers import bias_of, matmul
from mfvpr.utils.numerics import masked

_EPSILON = 1e-5  # of the normalization

Tree = TypeVar("Tree")
Sides = tuple[Array, Array]  # of the two images
States = Float[Array, "keypoints width"]
Heads = Float[Array, "heads keypoints numbers"]  # equally many numbers of a state for each head


class Affine(NamedTuple):
    """Weights of a linear layer."""

    kernel: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    @classmethod
    def of(cls, linear: nnx.Linear) -> "Affine":
        return cls(linear.kernel[...], bias_of(linear))

    def __call__(self, values: Float[Array, "keypoints inputs"]) -> Float[Array, "keypoints outputs"]:
        return matmul(values, self.kernel) + self.bias[None]


class Block(NamedTuple):
    """Weights of one kind of attention."""

    inputs: Affine  # states -> queries, keys and values (or keys and values), each head by head
    hidden: Affine  # state and context, concatenated -> hidden values of the update, twice as many
    scale: Float[Array, " 2*width"]  # of their normalization
    shift: Float[Array, " 2*width"]
    update: Affine  # hidden values -> change of the state

    def within(self, states: States, mask: Array, rotation: Float[Array, "2 keypoints angles"]) -> States:
        """States after self-attention of the keypoints of one image, masked by `mask`.

        The rotation encodes positions: cosines and sines of angles that turn pairs of numbers of a head, half a head
        apart.
        """
        queries, keys, values = _heads(self.inputs(states), 3, 2 * rotation.shape[2])
        cosine, sine = rotation[:, None]

        def rotate(numbers: Heads) -> Heads:
            first, second = jnp.split(numbers, 2, axis=-1)
            return jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)

        weights, total = _weights(matmul(rotate(queries), rotate(keys).swapaxes(1, 2)), mask, 2)
        return self._update(states, matmul(weights, values) / total)

    def across(self, states: Sides, masks: Sides, head: int) -> Sides:
        """States of both sides after cross-attention, with heads of `head` numbers.

        Weights over columns are not transposed, which would take several times longer on a CPU.
        """
        (keys0, values0), (keys1, values1) = (_heads(self.inputs(side), 2, head) for side in states)
        logits = matmul(keys0, keys1.swapaxes(1, 2))
        weights, total = _weights(logits, masks[1], 2)
        context0 = matmul(weights, values1) / total
        weights, total = _weights(logits, masks[0], 1)
        context1 = (matmul(values0.swapaxes(1, 2), weights) / total).swapaxes(1, 2)
        return self._update(states[0], context0), self._update(states[1], context1)

    def _update(self, states: States, context: Heads) -> States:
        together = jnp.concatenate([states, jnp.moveaxis(context, 0, 1).reshape(states.shape)], axis=1)
        hidden = self.hidden(together)
        centered = hidden - jnp.mean(hidden, axis=1, keepdims=True)
        variance = jnp.mean(centered * centered, axis=1, keepdims=True)
        hidden = centered * jax.lax.rsqrt(variance + _EPSILON) * self.scale[None] + self.shift[None]
        return states + self.update(jax.nn.gelu(hidden, approximate=False))


def _heads(values: Array, parts: int, head: int) -> Float[Array, "{parts} heads keypoints {head}"]:
    """Split the numbers of each keypoint into parts and heads."""
    return jnp.moveaxis(values.reshape(len(values), parts, -1, head), 0, 2)


def _weights(logits: Float[Array, "heads rows columns"], mask: Array, axis: int) -> tuple[Array, Array]:
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

    def pack(self, inputs: Affine) -> Block:
        """Weights of a block. The message and the first layer of the update are linear, so one product does both."""
        message, hidden = Affine.of(self.message), Affine.of(self.hidden)
        assert self.norm.scale is not None
        assert self.norm.bias is not None
        state_kernel, message_kernel = jnp.split(hidden.kernel, 2)
        kernel = jnp.concatenate([state_kernel, matmul(message.kernel, message_kernel)])
        joined = Affine(kernel, hidden.bias + matmul(message.bias, message_kernel))
        return Block(inputs, joined, self.norm.scale[...], self.norm.bias[...], Affine.of(self.update))


class Layer(nnx.Module):
    """Both kinds of attention, and the linear maps of the assignment after them."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.within, self.across = Attention(width, (3,), rngs=rngs), Attention(width, (1, 1), rngs=rngs)
        self.projection = nnx.Linear(width, width, rngs=rngs)
        self.matchability = nnx.Linear(width, 1, rngs=rngs)

    def pack(self, head: int) -> PackedLayer:
        """Weights of a layer with heads of `head` numbers.

        Queries are divided by the square root of `head`, and keys that meet keys by its fourth root. The rotation turns
        pairs of numbers: neighbors in the published weights, half a head apart here.
        """

        def arrange(outputs: Array) -> Array:
            parts = jnp.moveaxis(outputs.reshape(*outputs.shape[:-1], -1, head, 3), -1, 0)  # [3, ..., H, d]
            queries, keys = (jnp.concatenate([part[..., ::2], part[..., 1::2]], axis=-1) for part in parts[:2])
            return jnp.stack([queries / head**0.5, keys, parts[2]], axis=-3).reshape(outputs.shape)

        within = Affine(*map(arrange, Affine.of(self.within.inputs[0])))
        sides = zip(*map(Affine.of, self.across.inputs), strict=True)  # kernels, then biases, of keys and values
        across = Affine(*(jnp.concatenate([key / head**0.25, value], axis=-1) for key, value in sides))
        projection, root = Affine.of(self.projection), self.projection.out_features**0.25
        return PackedLayer(
            within=self.within.pack(within),
            across=self.across.pack(across),
            projection=Affine(projection.kernel / root, projection.bias / root),
            matchability=Affine.of(self.matchability),
        )


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
        layers = [layer.pack(2 * self.position.out_features) for layer in self.layers]
        confidences = list(map(Affine.of, self.confidences))
        return Packed(
            input=Affine.of(self.input),
            frequencies=self.position.kernel[...],
            layers=jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers),
            confidences=jax.tree.map(lambda *leaves: jnp.stack([*leaves, leaves[-1]]), *confidences),
        )


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
    sides = [_side(features, weights.frequencies) for features in (features0, features1)]
    inputs, masks, rotations = zip(*sides, strict=True)
    num_layers, head = len(weights.layers.projection.bias), 2 * weights.frequencies.shape[1]

    def run_layer(progress: tuple[Array, Sides, Array]) -> tuple[Array, Sides, Array]:
        number, states, done = progress
        layer = _at(weights.layers, number)
        states0, states1 = map(layer.within.within, states, masks, rotations)
        states = layer.across.across((states0, states1), masks, head)
        if depth_confidence is not None:
            threshold = 0.8 + 0.1 * jnp.exp(-4 * number.astype(states0.dtype) / num_layers)
            confidence = _at(weights.confidences, number)
            unsure = [
                jnp.sum(mask & (jax.nn.sigmoid(confidence(side)[:, 0]) < threshold))
                for side, mask in zip(states, masks, strict=True)
            ]
            total = jnp.maximum(jnp.sum(masks[0]) + jnp.sum(masks[1]), 1)
            done = 1 - (unsure[0] + unsure[1]) / total > depth_confidence
        return number + 1, states, done

    start = jnp.zeros((), jnp.int32), (weights.input(inputs[0]), weights.input(inputs[1])), jnp.zeros((), bool)
    is_running = lambda progress: (progress[0] < num_layers) & ~progress[2]  # noqa: E731
    number, states, _ = jax.lax.while_loop(is_running, run_layer, start)

    layer = _at(weights.layers, number - 1)
    similarity = matmul(layer.projection(states[0]), layer.projection(states[1]).T)
    real = masks[0][:, None] & masks[1][None]
    similarity = jnp.where(real, similarity, jnp.finfo(similarity.dtype).min)  # -inf gives NaN if none is real
    matchable0, matchable1 = (jax.nn.log_sigmoid(layer.matchability(side)[:, 0]) for side in states)
    both = jax.nn.log_softmax(similarity, axis=0) + jax.nn.log_softmax(similarity, axis=1)
    return masked(both + matchable0[:, None] + matchable1[None], real, -jnp.inf)


def _side(features: Features, frequencies: Float[Array, "2 angles"]) -> tuple[Array, Array, Array]:
    """Descriptors, mask and rotation `[2, N, angles]` of one image, without values that are not finite.

    The rotation is by positions in units of half of the image's longer side, from its center.
    """
    finite = [jnp.all(jnp.isfinite(values), axis=-1) for values in (features.descriptors, features.keypoints)]
    mask, size = features.mask & finite[0] & finite[1], features.image_size
    positions = (masked(features.keypoints, mask) - size[None] / 2) / (jnp.max(size) / 2)
    angles = matmul(positions, frequencies)
    return masked(features.descriptors, mask), mask, jnp.stack([jnp.cos(angles), jnp.sin(angles)])


def _at(stacked: Tree, layer: Array) -> Tree:
    return jax.tree.map(lambda leaf: leaf[layer], stacked)
