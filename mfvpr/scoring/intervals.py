"""Interval of the dominant shift from the scores of all bins. Lengths are pixels."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.scoring.lattice import Lattice
from mfvpr.types import Array


def mass_interval(
    scores: Float[Array, "bins bins"], lattice: Lattice, level: float | Array, sharpness: float | Array
) -> Float[jax.Array, "2 2"]:
    """Interval (low, high) of (x, y) with the central mass along each axis.

    The mass of a bin is s_ij^sharpness. Mass is spread evenly within a bin. Without votes all bins have the same mass.

    Args:
        scores: (y, x) s_ij, -inf beyond the range of shifts; scores below 0 count as 0.
        lattice: positions of the bins.
        level: share of the mass, between 0 and 1; the rest is split between both sides.
        sharpness: exponent; the larger, the less mass the lower bins have.
    """
    level, sharpness = (jnp.asarray(number, scores.dtype) for number in (level, sharpness))
    heights, in_range = jnp.maximum(scores, 0.0), (scores > -jnp.inf).astype(scores.dtype)
    top = jnp.max(heights)
    mass = jnp.where(top > 0, (heights / jnp.where(top > 0, top, 1.0)) ** sharpness, in_range)
    tail = (1 - level) / 2
    edges = jnp.arange(len(scores) + 1, dtype=scores.dtype) - 0.5  # in bins

    def along(axis: int) -> Array:
        below = jnp.concatenate([jnp.zeros(1, scores.dtype), jnp.cumsum(jnp.sum(mass, axis=axis))])
        return jnp.interp(jnp.stack([tail, 1 - tail]), below / below[-1], lattice.centers(axis, edges))

    return jnp.stack([along(0), along(1)], axis=1)
