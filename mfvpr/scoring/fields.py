"""What a field of a method may hold, and what people need to know of it, declared where the field stands.

From it follow the checks of words, and, in programs, settings with their bounds, comments and axes: programs write
plain values (numbers, words, lists, None), `Parameter.value` makes the field's of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from inspect import getmodule
from typing import Any

import numpy as np

from mfvpr.utils.errors import InputError

POSITIVE = (1e-6, 1e12)  # beyond these bounds float32 would fail, without a word
SCORE = "units of the score"
ANY = -1  # length of a list: one or more
_KEY = "parameter"  # of the field's metadata


@dataclass(frozen=True)
class Parameter:
    """What a field may hold, as plain values.

    Attributes:
        default: plain.
        unit: of a number.
        note: what name and unit do not say.
        choices: the only values; none = numbers within `bounds`.
        bounds: smallest and largest number.
        whole: numbers are whole.
        length: of a list of numbers; 0 = one number, ANY = a list of one or more.
        optional: None may be written as well.
        none: the field's value where None is written.
        named: the field's values by the words of `choices`.
        file: how the name of a file ends that may be written in place of a word; "" = none may.
        swept: worth an axis of a sweep.
        learned: a gradient may change it.
        start: where learning starts if its own value is None; of the unit `SCORE` in units of the scores' spread.
    """

    default: Any
    unit: str = ""
    note: str = ""
    choices: tuple[Any, ...] = ()
    bounds: tuple[float, float] = POSITIVE
    whole: bool = False
    length: int = 0
    optional: bool = False
    none: float | None = None
    named: Mapping[str, Any] | None = None
    file: str = ""
    swept: bool = True
    learned: bool = False
    start: float = 1.0

    @property
    def words(self) -> str:
        """The choices that are words, in a row."""
        words = [one for one in self.choices if isinstance(one, str)]
        return ", ".join([*words, f"FILE{self.file}"] if self.file else words)

    @property
    def limits(self) -> dict[str, Any]:
        """What checks a plain value, itself plain: `choices`, `whole` or `number`; what else is given."""
        kind = "choices" if self.choices else "whole" if self.whole else "number"
        limits = {kind: list(self.choices or self.bounds)}
        limits |= {"length": self.length, "optional": self.optional, "file": self.file}
        return {name: limit for name, limit in limits.items() if limit}

    def value(self, plain: Any) -> Any:
        """The field's value of a plain one."""
        if self.named is not None:
            return self.named[plain]
        if plain is None:
            return self.none
        return tuple(map(float, plain)) if self.length else plain


def number(
    default: float | None, unit: str = "", note: str = "", *, bounds: tuple[float, float] = POSITIVE, **more: Any
) -> Any:
    """A number, which may be traced; None, too, where that is the default. It is written for an infinite default."""
    unlimited = default == math.inf
    plain, none = (None, math.inf) if unlimited else (default, None)
    return _field(default, Parameter(plain, unit, note, bounds=bounds, optional=plain is None, none=none, **more))


def numbers(
    default: Sequence[float] | None, length: int, unit: str = "", note: str = "", *, bounds: tuple = POSITIVE
) -> Any:
    """A tuple of so many numbers; None, too, where that is the default."""
    plain = None if default is None else list(default)
    optional = default is None
    return _field(default, Parameter(plain, unit, note, bounds=bounds, length=length, optional=optional, swept=False))


def several(default: Sequence[float], unit: str = "", note: str = "", *, bounds: tuple[float, float] = POSITIVE) -> Any:
    """A tuple of one or more numbers, which chooses a program."""
    declared = Parameter([*default], unit, note, bounds=bounds, length=ANY, swept=False)
    return _field(tuple(default), declared, static=True)


def whole(default: int | None, unit: str = "", note: str = "", *, bounds: tuple[int, int], swept: bool = True) -> Any:
    """A whole number that chooses a program, such as a capacity; None, too, where that is the default."""
    optional = default is None
    declared = Parameter(default, unit, note, bounds=bounds, whole=True, optional=optional, swept=swept)
    return _field(default, declared, static=True)


def choice(default: str, *others: str, note: str = "") -> Any:
    """One of the words given, the first by default."""
    return _field(default, Parameter(default, note=note, choices=(default, *others)), static=True)


def flag(default: bool, note: str = "") -> Any:
    """True or False, which chooses a program."""
    return _field(default, Parameter(default, note=note, choices=(True, False)), static=True)


def named(values: Mapping[str, Any], default: str, note: str = "", *, file: str = "") -> Any:
    """One of the values of a table, written as its name; of files that end so, too, if the table reads them."""
    return _field(values[default], Parameter(default, note=note, choices=tuple(values), named=values, file=file))


def declared(method: Any) -> dict[str, Parameter]:
    """The parameters of a class, or of one of its instances, by field. Other fields are no settings."""
    return {one.name: one.metadata[_KEY] for one in fields(method) if _KEY in one.metadata}


def made(method: type, values: Mapping[str, Any]) -> Any:
    """An instance of plain values, by field."""
    known = declared(method)
    return method(**{name: known[name].value(plain) for name, plain in values.items()})


def summary(method: type) -> str:
    """What it is: the first line of its module."""
    return (getmodule(method).__doc__ or method.__name__).splitlines()[0]


def check_choices(method: Any) -> None:
    """Raise a ValueError that names the field whose word is none of its choices."""
    for name, parameter in declared(method).items():
        choices, value = parameter.choices, getattr(method, name)
        if choices and parameter.named is None and value not in choices:
            expected = ", ".join(map(str, choices))
            raise ValueError(f"{type(method).__name__}({name}={value!r}): expected one of {expected}")


def check_bounds(method: Any) -> None:
    """Raise an InputError that names the field whose number, which is no traced one, is beyond its bounds."""
    for name, parameter in declared(method).items():
        value, (low, high) = getattr(method, name), parameter.bounds
        if parameter.choices or value is None:
            continue
        values = np.ravel(np.asarray(value, float))
        if not ((values >= low) & (values <= high) | (values == parameter.none)).all():
            raise InputError(f"{name}={value}: expected numbers from {low:g} to {high:g}")


def _field(default: Any, parameter: Parameter, *, static: bool = False) -> Any:
    return field(default=default, metadata={"static": static, _KEY: parameter})
