"""Positive numbers (sigma, temperature, tolerance, ...) are learned through their logarithm."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from mfvpr.errors import InputError
from mfvpr.numerics import as_float
from mfvpr.types import Array


def to_logarithms(values: Mapping[str, float | Array]) -> dict[str, Array]:
    """Free parameters, any real number, of positive values of any shape.

    Raises:
        InputError: a value is not above 0, or infinite.
    """
    for name, value in values.items():
        if not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise InputError(f"{name}={value}: expected a number above 0 to start from")
    return {name: jnp.log(as_float(value)) for name, value in values.items()}


def from_logarithms(parameters: Mapping[str, Array]) -> dict[str, Array]:
    """The positive values of free parameters, as `dataclasses.replace(scorer, **values)` takes them."""
    return {name: jnp.exp(parameter) for name, parameter in parameters.items()}
