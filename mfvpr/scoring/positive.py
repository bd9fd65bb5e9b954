"""Numbers of a scorer that mean something only above 0: widths and temperatures."""

from typing import Any

import jax.numpy as jnp

from mfvpr.types import Array


def positive(value: float | Array, dtype: Any) -> Array:
    """`value` where it is above 0, NaN elsewhere: no width, no score."""
    value = jnp.asarray(value, dtype=dtype)
    return jnp.where(value > 0, value, jnp.nan)
