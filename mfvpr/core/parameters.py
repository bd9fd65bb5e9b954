"""Parameters of scorers: declared at the field, from which settings, sweeps and learning follow; by dotted name.

sigma: float | Array = setting(22.5, POSITIVE, unit="px", learned=True)  # a field of a scorer
parameters_of(HistogramOfShifts)["sigma"].unit              # "px"
with_parameters(scorer, {"inner.sigma": 10.0})              # a field of a part
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey
from jaxtyping import Num

from mfvpr.core.types import Array
from mfvpr.utils.fields import Setting

SCORE = "units of the score"


def parameters_of(method: Any) -> dict[str, Setting]:
    """Declared fields of a class, or of an instance, by name."""
    return {f.name: f.metadata["setting"] for f in fields(method) if "setting" in f.metadata}


def check_bounds(method: Any) -> None:
    """Raise an InputError if a field holds a number out of bounds; none may be traced."""
    for name, parameter in parameters_of(method).items():
        parameter.check_numbers(name, getattr(method, name))


def numbers_by_name(scorer: Any) -> dict[str, Any]:
    """Numbers of a scorer by dotted name, which a grid may vary; also a `temperature` of None."""
    leaves = jax.tree_util.tree_leaves_with_path(scorer, is_leaf=lambda leaf: leaf is None)
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in leaves
        if path and all(isinstance(key, GetAttrKey) for key in path)
        if _is_number(leaf) or (leaf is None and path[-1].name == "temperature")
    }


def _is_number(value: Any) -> bool:
    scalar = isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0
    return scalar and (jnp.issubdtype(jnp.result_type(value), jnp.number) or isinstance(value, bool | np.bool_))


def whole_numbers(scorer: Any) -> set[str]:
    """Names of the numbers that are integers, such as indices, and must remain integers."""
    is_whole = lambda number: jnp.issubdtype(jnp.result_type(number), jnp.integer)  # noqa: E731
    return {name for name, number in numbers_by_name(scorer).items() if number is not None and is_whole(number)}


def static_names(scorer: Any) -> set[str]:
    """Dotted names of the static fields of a scorer, whose values select the compiled program."""
    names = set()
    for f in fields(scorer) if is_dataclass(scorer) else ():
        if f.metadata.get("static"):
            names.add(f.name)
        else:
            names |= {f"{f.name}.{name}" for name in static_names(getattr(scorer, f.name))}
    return names


def with_parameters(scorer: Any, values: Mapping[str, Any]) -> Any:
    """The scorer with parameters replaced by `values`, by dotted name."""
    for name, new in values.items():
        outer, _, inner = name.partition(".")
        part = with_parameters(getattr(scorer, outer), {inner: new}) if inner else new
        scorer = replace(scorer, **{outer: part})
    return scorer


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
