"""Vectors of unit length."""

import jax.numpy as jnp
from jaxtyping import Float

from mfvpr.types import Array

EPSILON = 1e-12  # least divisor, as in the public codes


def of_unit_length(vectors: Float[Array, "*batch dimensions"]) -> Float[Array, "*batch dimensions"]:
    """Vectors divided by their lengths."""
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), EPSILON)
