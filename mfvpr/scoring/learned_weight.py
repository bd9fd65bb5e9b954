"""A match weight that is learned: a small network of what is known about one match."""

import math
from collections.abc import Callable, Mapping
from dataclasses import field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.scoring.weights import match_ratio
from mfvpr.types import Array, Matches, value
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float, masked, masked_median

RELATIVE = ("ratio", "distance_rank", "relative_distance", "score0_rank", "score1_rank")
ABSOLUTE = ("scores0", "scores1", "distance", "ratio", "x0", "y0", "x1", "y1")
_UNIT_BIAS = math.log(math.e - 1)  # softplus of it is 1


@value
class LearnedWeight:
    """w = softplus(z), z = v . tanh(x M + b) + c, of the standardized inputs x of a match; above 0, dimensionless.

    `center` and `scale` are statistics: they have no gradient, so an optimizer leaves them alone (but one with weight
    decay must be told to: `optax.masked`).

    Attributes:
        center: `[F]` mean of every input.
        scale: `[F]` its standard deviation.
        hidden: `[F, H]` M.
        hidden_bias: `[H]` b.
        output: `[H]` v.
        output_bias: `[]` c.
        names: of the F inputs, of `INPUTS`. RELATIVE ones compare a match with those of its own pair, so that they mean
            the same of another detector, camera or place; ABSOLUTE ones are in units of these.
    """

    center: Array  # [F]
    scale: Array  # [F]
    hidden: Array  # [F, H]
    hidden_bias: Array  # [H]
    output: Array  # [H]
    output_bias: Array  # []
    names: tuple[str, ...] = field(default=RELATIVE, metadata={"static": True})

    @classmethod
    def create(
        cls, key: Array, matches: Matches, hidden: int = 16, *, names: tuple[str, ...] = RELATIVE
    ) -> "LearnedWeight":
        """A weight that is 1 everywhere, with the statistics of real matches.

        Args:
            key: of `jax.random`, for the hidden layer.
            matches: `[..., K]`; padding may hold anything. Without a real match, inputs are not standardized.
            hidden: H.
            names: of the inputs.

        Raises:
            InputError: the matches have no ratio, or there is no such input.
        """
        if not names or isinstance(names, str) or len({*names}) < len(names):
            raise InputError(f"LearnedWeight: expected different names of inputs, got {names}")
        names = (*names,)
        if unknown := [name for name in names if name not in INPUTS]:
            raise InputError(f"LearnedWeight: unknown input {unknown[0]}; expected some of {', '.join(INPUTS)}")
        raw = np.asarray(jax.jit(_raw_inputs, static_argnums=1)(matches, names), np.float64)
        real = raw[np.asarray(matches.mask)]
        shape = (len(names), hidden)
        center, deviation = (real.mean(axis=0), real.std(axis=0)) if len(real) else np.zeros((2, shape[0]))
        varies = deviation > 1e-5 * np.abs(center)  # a constant input deviates by rounding alone
        return cls(
            center=jnp.asarray(center, dtype=float),
            scale=jnp.asarray(np.where(varies, deviation, 1.0), dtype=float),
            hidden=jax.random.normal(key, shape, dtype=float) / shape[0] ** 0.5,
            hidden_bias=jnp.zeros(hidden),
            output=jnp.zeros(hidden),
            output_bias=jnp.asarray(_UNIT_BIAS, dtype=float),
            names=names,
        )

    def __call__(self, matches: Matches) -> Array:
        """`[K]` weights of one pair; finite on padding.

        Raises:
            InputError: the matches have no ratio.
        """
        weights = jax.nn.softplus(self.logits(matches))
        return jnp.maximum(weights, jnp.finfo(weights.dtype).tiny)  # softplus may underflow

    def logits(self, matches: Matches) -> Array:
        """`[K]` z of one pair: the logarithm of the odds that a match is right, where that is what was taught.

        Raises:
            InputError: the matches have no ratio.
        """
        exact = jax.lax.Precision.HIGHEST
        hidden = jnp.tanh(jnp.matmul(self.inputs(matches), self.hidden, precision=exact) + self.hidden_bias[None])
        return jnp.matmul(hidden, self.output, precision=exact) + self.output_bias

    def inputs(self, matches: Matches) -> Array:
        """`[K, F]` what the network sees of every match, standardized.

        `center + scale * inputs` undoes the standardization.

        Raises:
            InputError: the matches have no ratio.
        """
        center, scale = jax.lax.stop_gradient((jnp.asarray(self.center), jnp.asarray(self.scale)))
        return (_raw_inputs(matches, self.names) - center[None]) / scale[None]


def _raw_inputs(matches: Matches, names: tuple[str, ...]) -> Array:
    """`[..., K, F]`; 0 on padding."""
    columns = [masked(jnp.broadcast_to(INPUTS[name](matches), matches.mask.shape), matches.mask) for name in names]
    return jnp.stack(columns, axis=-1)


def _itself(name: str, matches: Matches) -> Array:
    return as_float(getattr(matches, name))


def _rank(name: str, matches: Matches) -> Array:
    """The share of the pair's matches that are below, in (0, 1); of equals, half."""
    values = masked(as_float(getattr(matches, name)), matches.mask)
    return jax.lax.stop_gradient(jnp.vectorize(_mid_ranks, signature="(k),(k)->(k)")(values, matches.mask))


def _mid_ranks(values: Array, mask: Array) -> Array:
    ordered = jnp.sort(masked(values, mask, jnp.inf))
    below, up_to = (jnp.searchsorted(ordered, values, side=side) for side in ("left", "right"))
    return (below + up_to).astype(values.dtype) / (2 * jnp.maximum(jnp.sum(mask), 1)).astype(values.dtype)


def _relative_distance(matches: Matches) -> Array:
    """In units of the median of the pair's."""
    distance = masked(as_float(matches.distance), matches.mask)
    median = jnp.vectorize(masked_median, signature="(k),(k)->()")(distance, matches.mask)[..., None]
    return distance / jnp.where(median > 0, median, 1.0)


def _place(side: int, axis: int, matches: Matches) -> Array:
    """A coordinate relative to the image's center, in units of half its size."""
    points, size = getattr(matches, f"points{side}"), getattr(matches, f"image_size{side}")
    half = jnp.broadcast_to(as_float(size)[..., None, axis] / 2, matches.mask.shape)
    half = masked(half, matches.mask, 1.0)  # a padded pair's image may have any size
    return masked(as_float(points)[..., axis], matches.mask, half) / half - 1


INPUTS: Mapping[str, Callable[[Matches], Any]] = {
    "ratio": match_ratio,
    "distance_rank": partial(_rank, "distance"),
    "relative_distance": _relative_distance,
    "score0_rank": partial(_rank, "scores0"),
    "score1_rank": partial(_rank, "scores1"),
    "scores0": partial(_itself, "scores0"),
    "scores1": partial(_itself, "scores1"),
    "distance": partial(_itself, "distance"),
    "x0": partial(_place, 0, 0),
    "y0": partial(_place, 0, 1),
    "x1": partial(_place, 1, 0),
    "y1": partial(_place, 1, 1),
}
"""What a learned weight may see of a match, `[..., K]`, by name; what it gives on padding is arbitrary."""
