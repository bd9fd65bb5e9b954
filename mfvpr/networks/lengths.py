"""Vectors of unit length."""

import jax.numpy as jnp
from jax import Array

EPSILON = 1e-12  # the public codes': shorter vectors, such as zero, are divided by it


def of_unit_length(vectors: Array) -> Array:
    """`[..., D]`, each divided by its length."""
    return vectors / jnp.maximum(jnp.linalg.norm(vectors, axis=-1, keepdims=True), EPSILON)
