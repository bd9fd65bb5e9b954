"""Parameters of scorers to learn. Positive numbers (sigma, temperature, ...) are learned through their logarithm."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from mfvpr.scoring.fields import SCORE, parameters_of
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of scorers, has fields that are declared to be learned."""
    return any(parameter.learned for parameter in parameters_of(scorer).values())


def starts(scorer: Any, spread: float) -> dict[str, float]:
    """Values to start learning from, by field: the scorer's values, or declared ones for fields that are None.

    `spread` is the standard deviation of the scores.
    """
    values = {}
    for name, field in parameters_of(scorer).items():
        if field.learned:
            default = field.start * (spread if field.unit == SCORE else 1.0)
            value = getattr(scorer, name)
            values[name] = float(default if value is None else value)
    return values


def to_logarithms(values: Mapping[str, float | Array]) -> dict[str, Array]:
    """Unbounded parameters from positive values of any shape; others raise `InputError`."""
    for name, value in values.items():
        if not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise InputError(f"{name}={value}: expected a number above 0 to start from")
    return {name: jnp.log(as_float(value)) for name, value in values.items()}


def from_logarithms(parameters: Mapping[str, Array]) -> dict[str, Array]:
    """Positive values from unbounded parameters, for `dataclasses.replace(scorer, **values)`."""
    return {name: jnp.exp(parameter) for name, parameter in parameters.items()}
