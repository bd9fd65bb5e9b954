"""A match weight that is learned: a small network of what is known about one match."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from mfvpr.numerics import as_float, masked
from mfvpr.types import Array, Matches, value
from mfvpr.weighting import match_ratio

FEATURE_NAMES = ("scores0", "scores1", "distance", "ratio", "x0", "y0", "x1", "y1")
_UNIT_BIAS = math.log(math.e - 1)  # softplus of it is 1


@value
class LearnedWeight:
    """w = softplus(v . tanh(z M + b) + c) of the standardized inputs z of a match; above 0, dimensionless.

    `center` and `scale` are statistics: they have no gradient, so an optimizer leaves them alone (but one with weight
    decay must be told to: `optax.masked`).

    Attributes:
        center: `[F]` mean of every input.
        scale: `[F]` its standard deviation.
        hidden: `[F, H]` M.
        hidden_bias: `[H]` b.
        output: `[H]` v.
        output_bias: `[]` c.
    """

    center: Array  # [F]
    scale: Array  # [F]
    hidden: Array  # [F, H]
    hidden_bias: Array  # [H]
    output: Array  # [H]
    output_bias: Array  # []

    @classmethod
    def create(cls, key: Array, matches: Matches, hidden: int = 16) -> "LearnedWeight":
        """A weight that is 1 everywhere, with the statistics of real matches.

        Args:
            key: of `jax.random`, for the hidden layer.
            matches: `[..., K]`; padding may hold anything. Without a real match, inputs are not standardized.
            hidden: H.

        Raises:
            InputError: the matches have no ratio.
        """
        real = np.asarray(jax.jit(_raw_inputs)(matches), np.float64)[np.asarray(matches.mask)]
        shape = (len(FEATURE_NAMES), hidden)
        center, deviation = (real.mean(axis=0), real.std(axis=0)) if len(real) else np.zeros((2, shape[0]))
        varies = deviation > 1e-5 * np.abs(center)  # a constant input deviates by rounding alone
        return cls(
            center=jnp.asarray(center, dtype=float),
            scale=jnp.asarray(np.where(varies, deviation, 1.0), dtype=float),
            hidden=jax.random.normal(key, shape, dtype=float) / shape[0] ** 0.5,
            hidden_bias=jnp.zeros(hidden),
            output=jnp.zeros(hidden),
            output_bias=jnp.asarray(_UNIT_BIAS, dtype=float),
        )

    def __call__(self, matches: Matches) -> Array:
        """`[K]` weights of one pair; finite on padding.

        Raises:
            InputError: the matches have no ratio.
        """
        exact = jax.lax.Precision.HIGHEST
        hidden = jnp.tanh(jnp.matmul(self.inputs(matches), self.hidden, precision=exact) + self.hidden_bias[None])
        weights = jax.nn.softplus(jnp.matmul(hidden, self.output, precision=exact) + self.output_bias)
        return jnp.maximum(weights, jnp.finfo(weights.dtype).tiny)  # softplus may underflow

    def inputs(self, matches: Matches) -> Array:
        """`[K, F]` what the network sees of every match: `FEATURE_NAMES`, standardized.

        Positions are relative to the image's center in units of half its size; `center + scale * inputs` undoes the
        standardization.

        Raises:
            InputError: the matches have no ratio.
        """
        center, scale = jax.lax.stop_gradient((jnp.asarray(self.center), jnp.asarray(self.scale)))
        return (_raw_inputs(matches) - center[None]) / scale[None]


def _raw_inputs(matches: Matches) -> Array:
    """`[..., K, F]`; 0 on padding."""
    columns = (matches.scores0, matches.scores1, matches.distance, match_ratio(matches))
    scalars = jnp.stack([masked(as_float(column), matches.mask) for column in columns], axis=-1)
    places0 = _places(matches.points0, matches.image_size0, matches.mask)
    places1 = _places(matches.points1, matches.image_size1, matches.mask)
    return jnp.concatenate([scalars, places0, places1], axis=-1)


def _places(points: Array, image_size: Array, mask: Array) -> Array:
    """`[..., K, 2]` points relative to the image's center, in units of half its size; 0 on padding."""
    points = as_float(points)
    half = jnp.broadcast_to(as_float(image_size)[..., None, :] / 2, points.shape)
    half = masked(half, mask, 1.0)  # a padded pair's image may have any size
    return masked(points, mask, half) / half - 1
