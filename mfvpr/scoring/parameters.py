"""Parameters of a scorer by dotted name (`inner.sigma`), and capacities that fit image sizes."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey
from jaxtyping import Num

from mfvpr.types import Array


def numbers_by_name(scorer: Any) -> dict[str, Any]:
    """Numbers of a scorer by dotted name, which a grid may vary; also a `temperature` of None."""
    leaves = jax.tree_util.tree_leaves_with_path(scorer, is_leaf=lambda leaf: leaf is None)
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in leaves
        if path and all(isinstance(key, GetAttrKey) for key in path)
        if _is_number(leaf) or (leaf is None and path[-1].name == "temperature")
    }


def whole_numbers(scorer: Any) -> set[str]:
    """Names of the numbers that are integers, such as indices, and must remain integers."""
    is_whole = lambda number: jnp.issubdtype(jnp.result_type(number), jnp.integer)  # noqa: E731
    return {name for name, number in numbers_by_name(scorer).items() if number is not None and is_whole(number)}


def static_names(scorer: Any) -> set[str]:
    """Dotted names of the static fields of a scorer, whose values select the compiled program."""
    names = set()
    for field in fields(scorer) if is_dataclass(scorer) else ():
        if field.metadata.get("static"):
            names.add(field.name)
        else:
            names |= {f"{field.name}.{name}" for name in static_names(getattr(scorer, field.name))}
    return names


def with_parameters(scorer: Any, values: Mapping[str, Any]) -> Any:
    """The scorer with parameters replaced by `values`, by dotted name."""
    return reduce(lambda varied, parameter: _replace(varied, *parameter), values.items(), scorer)


def with_capacity(
    scorer: Any, image_size0: Num[Array, "*batch0 2"], image_size1: Num[Array, "*batch1 2"], *, multiple: int = 1
) -> Any:
    """The scorer with the capacities that pairs of these image sizes need, before `vmap` or `jit` hide the sizes.

    The method `fit_capacity(image_size0, image_size1, multiple)` of parts at any depth sets them, see
    `HistogramOfShifts`; values up to the same `multiple` share programs.
    """
    has_capacity = lambda part: callable(getattr(part, "fit_capacity", None))  # noqa: E731

    def fit_part(part: Any) -> Any:
        return part.fit_capacity(image_size0, image_size1, multiple) if has_capacity(part) else part

    return jax.tree.map(fit_part, scorer, is_leaf=has_capacity)


def _replace(scorer: Any, name: str, value: Any) -> Any:
    outer, _, inner = name.partition(".")
    return replace(scorer, **{outer: _replace(getattr(scorer, outer), inner, value) if inner else value})


def _is_number(value: Any) -> bool:
    scalar = isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0
    return scalar and (jnp.issubdtype(jnp.result_type(value), jnp.number) or isinstance(value, bool | np.bool_))
