"""Positive numbers (sigma, temperature, tolerance, ...) are learned through their logarithm."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from mfvpr.scoring.fields import SCORE, declared
from mfvpr.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.numerics import as_float


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of them, has numbers that are declared to be learned."""
    return any(parameter.learned for parameter in declared(scorer).values())


def starts(scorer: Any, spread: float) -> dict[str, float]:
    """Where learning starts, by the fields that are learned: its own values, or those declared where it has none.

    Args:
        scorer: a value.
        spread: of its scores.
    """
    learned = {name: parameter for name, parameter in declared(scorer).items() if parameter.learned}
    own = {name: getattr(scorer, name) for name in learned}
    begin = {name: one.start * (spread if one.unit == SCORE else 1.0) for name, one in learned.items()}
    return {name: float(begin[name] if value is None else value) for name, value in own.items()}


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
