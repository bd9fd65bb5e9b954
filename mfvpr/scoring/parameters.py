"""A scorer's parameters by name, `inner.sigma` for those of its parts; and its capacities, fitted to images."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey

from mfvpr.types import Array


def numbers(scorer: Any) -> dict[str, Any]:
    """Its scalar leaves by dotted name: what `score_grid` may vary. A temperature that is None is one as well."""
    leaves = jax.tree_util.tree_leaves_with_path(scorer, is_leaf=lambda leaf: leaf is None)
    named = {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in leaves
        if path and all(isinstance(key, GetAttrKey) for key in path)
    }
    return {
        name: leaf
        for name, leaf in named.items()
        if _is_number(leaf) or (leaf is None and name.rpartition(".")[2] == "temperature")
    }


def whole_numbers(scorer: Any) -> set[str]:
    """Names of those `numbers` that are whole: others in their place are, too, and may be indices."""
    return {name for name, number in numbers(scorer).items() if number is not None and _is_whole(number)}


def choices(scorer: Any) -> set[str]:
    """Dotted names of its static fields, each value of which is a program of its own."""
    found = set()
    for field in fields(scorer) if is_dataclass(scorer) else ():
        if field.metadata.get("static"):
            found.add(field.name)
        else:
            found |= {f"{field.name}.{name}" for name in choices(getattr(scorer, field.name))}
    return found


def with_parameters(scorer: Any, values: Mapping[str, Any]) -> Any:
    """The scorer with other values of some parameters, by dotted name."""
    return reduce(lambda made, item: _with(made, *item), values.items(), scorer)


def fit(scorer: Any, image_size0: Array, image_size1: Array, *, multiple: int = 1) -> Any:
    """The scorer whose parts have the capacities that pairs of these sizes need, before `vmap` or `jit` hide them.

    A part is fitted by its method `fitted(image_size0, image_size1, multiple)`, as that of `HistogramOfShifts`.

    Args:
        scorer: any; parts may be anywhere in it.
        image_size0: `[..., 2]` px, of queries.
        image_size1: `[..., 2]` px, of candidates.
        multiple: capacities are multiples of it, so that few programs serve many values.
    """
    fits = lambda part: callable(getattr(part, "fitted", None))  # noqa: E731
    size = lambda part: part.fitted(image_size0, image_size1, multiple) if fits(part) else part  # noqa: E731
    return jax.tree.map(size, scorer, is_leaf=fits)


def _with(scorer: Any, name: str, value: Any) -> Any:
    outer, _, inner = name.partition(".")
    return replace(scorer, **{outer: _with(getattr(scorer, outer), inner, value) if inner else value})


def _is_number(value: Any) -> bool:
    scalar = isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0
    return scalar and (jnp.issubdtype(jnp.result_type(value), jnp.number) or isinstance(value, bool | np.bool_))


def _is_whole(number: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(number), jnp.integer)
