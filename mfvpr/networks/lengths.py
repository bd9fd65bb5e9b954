"""Vectors of unit length."""

import jax.numpy as jnp
from jax import Array

EPSILON = 1e-12  # least divisor, as in the public codes


def of_unit_length(vectors: Array) -> Array:
    """Vectors `[..., D]` divided by their lengths."""
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), EPSILON)
