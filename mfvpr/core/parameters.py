"""Parameters of scorers: declared at the field, from which settings, sweeps and learning follow; by dotted name.

sigma: float | Array = number(22.5, "px", learned=True)     # a field of a scorer
parameters_of(HistogramOfShifts)["sigma"].unit              # "px"
with_parameters(scorer, {"inner.sigma": 10.0})              # a field of a part
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey
from jaxtyping import Num

from mfvpr.core.types import Array
from mfvpr.utils.errors import InputError

POSITIVE = (1e-6, 1e12)  # beyond these bounds float32 silently overflows or underflows
SCORE = "units of the score"


@dataclass(frozen=True)
class Parameter:
    """Declaration of one field in plain values: numbers, words, flags, lists, None."""

    default: Any
    unit: str = ""
    note: str = ""
    choices: tuple[Any, ...] = ()  # all allowed values; empty = numbers within `bounds`
    bounds: tuple[float, float] = POSITIVE
    whole: bool = False  # numbers are integers
    length: int = 0  # of a list of numbers; 0 = one number
    none: float | None = None  # field value for None, which is allowed if it is the default
    swept: bool = True  # offered as an axis of a sweep
    learned: bool = False  # a gradient may change the field
    start: float = 1.0  # of learning if the value is None; for the unit `SCORE` in units of the scores' spread

    def value(self, plain: Any) -> Any:
        """Field value of a plain value; the words of a weight stand for themselves."""
        if plain is None:
            return self.none
        return tuple(map(float, plain)) if self.length else plain

    def check(self, name: str, value: Any) -> None:
        """Raise an InputError if a concrete number, or one of several, is out of bounds."""
        values, (low, high) = np.ravel(np.asarray(value, float)), self.bounds
        if not ((values >= low) & (values <= high) | (values == self.none)).all():
            raise InputError(f"{name}={value}: expected numbers from {low:g} to {high:g}")


def declare(default: Any, parameter: Parameter, *, static: bool = False) -> Any:
    """A field of a value with a default and its declaration."""
    return field(default=default, metadata={"static": static, "parameter": parameter})


def number(
    default: float | None, unit: str = "", note: str = "", *, bounds: tuple[float, float] = POSITIVE, **more: Any
) -> Any:
    """Declare a number; None is allowed if the default is None, or infinite (None = infinite)."""
    plain, none = (None, math.inf) if default == math.inf else (default, None)
    return declare(default, Parameter(plain, unit, note, bounds=bounds, none=none, **more))


def numbers(
    default: Sequence[float] | None, length: int, unit: str = "", note: str = "", *, bounds: tuple = POSITIVE
) -> Any:
    """Declare a tuple of `length` numbers, None is allowed if it is the default."""
    plain = None if default is None else list(default)
    return declare(default, Parameter(plain, unit, note, bounds=bounds, length=length, swept=False))


def integer(default: int | None, unit: str = "", note: str = "", *, bounds: tuple[int, int], swept: bool = True) -> Any:
    """Declare a static integer, such as a capacity; None is allowed if it is the default."""
    return declare(default, Parameter(default, unit, note, bounds=bounds, whole=True, swept=swept), static=True)


def choice(default: str, *alternatives: str, note: str = "") -> Any:
    """Declare a static word, one of `default` and the alternatives."""
    return declare(default, Parameter(default, note=note, choices=(default, *alternatives)), static=True)


def flag(default: bool, note: str = "") -> Any:
    """Declare a static boolean."""
    return declare(default, Parameter(default, note=note, choices=(True, False)), static=True)


def parameters_of(method: Any) -> dict[str, Parameter]:
    """Parameters of a class, or of an instance, by name of the field."""
    return {f.name: f.metadata["parameter"] for f in fields(method) if "parameter" in f.metadata}


def check_plain(method: Any) -> None:
    """Raise an InputError for a word that is not one of the choices, for no weight, or a Python float out of bounds."""
    for f in fields(method):
        choices, value = getattr(f.metadata.get("parameter"), "choices", ()), getattr(method, f.name)
        is_weight = callable(f.default)  # its choices are words of settings
        if choices and not (callable(value) if is_weight else value in choices):
            expected = "a weight such as RatioWeight()" if is_weight else f"one of {', '.join(map(str, choices))}"
            raise InputError(f"{type(method).__name__}({f.name}={value!r}): expected {expected}")
    check_bounds(method, all_arrays=False)


def check_bounds(method: Any, *, all_arrays: bool = True) -> None:
    """Raise an InputError if a field holds a number out of bounds; no number may be traced if `all_arrays` count."""
    for name, parameter in parameters_of(method).items():
        value = getattr(method, name)
        parts = value if isinstance(value, tuple) else (value,)
        is_plain = not parameter.whole and all(isinstance(part, int | float) for part in parts)
        if not parameter.choices and value is not None and (is_plain or all_arrays):
            parameter.check(name, value)


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
