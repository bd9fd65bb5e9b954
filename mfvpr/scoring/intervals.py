"""How sure a dominant shift is, from the heights of all bins. Lengths are pixels."""

import jax.numpy as jnp

from mfvpr.scoring.lattice import Lattice
from mfvpr.types import Array


def mass_interval(scores: Array, lattice: Lattice, level: float | Array, sharpness: float | Array) -> Array:
    """`[2, 2]` (low, high) of (x, y): the middle part of a mass that is s_ij^sharpness in every bin, along each axis.

    Mass is spread evenly within a bin. Where nothing votes every bin has the same.

    Args:
        scores: `[B, B]` (y, x) of the bins, -inf of those that there are not; below 0 they count as 0.
        lattice: where they are.
        level: of the mass, between 0 and 1; as much is left out on either side.
        sharpness: of the mass: the larger, the less the lower bins have.
    """
    level, sharpness = (jnp.asarray(number, scores.dtype) for number in (level, sharpness))
    heights, there = jnp.maximum(scores, 0.0), (scores > -jnp.inf).astype(scores.dtype)
    top = jnp.max(heights)
    mass = jnp.where(top > 0, (heights / jnp.where(top > 0, top, 1.0)) ** sharpness, there)
    tail = (1 - level) / 2
    edges = jnp.arange(len(scores) + 1, dtype=scores.dtype) - 0.5  # in bins

    def along(axis: int) -> Array:
        below = jnp.concatenate([jnp.zeros(1, scores.dtype), jnp.cumsum(jnp.sum(mass, axis=axis))])
        return jnp.interp(jnp.stack([tail, 1 - tail]), below / below[-1], lattice.centers(axis, edges))

    return jnp.stack([along(0), along(1)], axis=1)
