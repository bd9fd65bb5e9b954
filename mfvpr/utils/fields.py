"""Settings: fields of frozen dataclasses with a default, the allowed values, and a sentence.

    @value
    class HistogramOfShifts:
        sigma: float | Array = setting(22.5, POSITIVE, unit="px", learned=True)
        max_bins: int | None = setting(None, whole(1, 1024) | None, "null = what the image size needs", static=True)

        __post_init__ = check_fields

Programs make their settings, what `--help` says about them, and the axes of sweeps and learning from these fields.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, get_args

import numpy as np

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle

REQUIRED = "???"  # the default of a setting without one, in Hydra's words
_KEY, _GROUP = "setting", "group"  # of the field's metadata
_MAX_SHOWN = 200  # characters of a value in an error
Owner = TypeVar("Owner")


@dataclass(frozen=True)
class Rule:
    """The allowed values of a setting, and the same in words; `rule | word` allows a word, or None, as well."""

    holds: Callable[[Any], bool]
    expected: str
    bounds: tuple[float, float] | None = None  # of numbers
    is_whole: bool = False  # numbers are integers

    def __or__(self, other: Any) -> "Rule":
        if not isinstance(other, Rule):
            other = one_of(other)
        words = f"{self.expected}, or {other.expected.removeprefix('one of ')}"
        return replace(self, holds=lambda value: self.holds(value) or other.holds(value), expected=words)

    def check(self, name: str, value: Any) -> None:
        """Raise an InputError for a value that is not allowed."""
        if not self.holds(value):
            got = "null" if value is None else clip_middle(" ".join(str(value).split()), _MAX_SHOWN)
            raise InputError(f"{name}={got}: expected {self.expected}")


def one_of(*choices: Any) -> Rule:
    """Some words, numbers, flags or None."""
    words = ", ".join({"None": "null", "True": "true", "False": "false"}.get(str(each), str(each)) for each in choices)
    typed = [(type(choice), choice) for choice in choices]  # 1 is not True
    return Rule(lambda value: (type(value), value) in typed, f"one of {words}")


def word_of(words: Any) -> Rule:
    """A word of a `Literal`."""
    return one_of(*get_args(words))


def text(pattern: str = r"(?s).+", expected: str = "text") -> Rule:
    """Text that matches a regular expression."""
    return Rule(lambda value: isinstance(value, str) and bool(re.fullmatch(pattern, value)), expected)


def number(low: float, high: float, kind: Any = int | float | np.number) -> Rule:
    """A number in a range, its ends included."""
    holds = lambda value: isinstance(value, kind) and not isinstance(value, bool) and bool(low <= value <= high)  # noqa: E731
    return Rule(holds, f"a number from {low:g} to {high:g}", (low, high))


def whole(low: int, high: int) -> Rule:
    """An integer in a range, its ends included."""
    rule = number(low, high, int | np.integer)
    return replace(rule, expected=f"a whole number from {low} to {high}", is_whole=True)


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of a given length, or of any above 0."""

    def holds(value: Any) -> bool:
        has_length = isinstance(value, list | tuple) and (len(value) == length if length else bool(value))
        return has_length and all(map(rule.holds, value))

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}", rule.bounds)


def or_list(rule: Rule) -> Rule:
    """A value that a rule allows, or a list of such values."""
    return rule | replace(list_of(rule), expected="a list of them")


FLAG = one_of(True, False)
POSITIVE = number(1e-6, 1e12)  # beyond these bounds float32 and int32 would fail silently
NOT_NEGATIVE = number(0, 1e12)
COUNT = whole(1, 10**6)
INDEX = whole(0, 10**6)
SIZE = list_of(whole(16, 4096), 2)
SHAPED_SIZE = "width, height; auto: the first database image's shape at the default number of pixels; N: at N pixels"
TEXT = text()
PATH = text(r"(?s)(?!.*\$\{).+", "a path with variables filled in")


@dataclass(frozen=True)
class Setting:
    """A setting that programs offer: its default as a plain value, the allowed values, and a sentence."""

    default: Any
    rule: Rule
    note: str = ""
    unit: str = ""
    swept: bool = True  # a field of a scorer is offered as an axis of sweeps
    learned: bool = False  # a gradient may change the field
    start: float = 1.0  # of learning if the value is None
    none: float | None = None  # value of the field for None

    def value(self, plain: Any) -> Any:
        """Field value of a plain value; the words of a weight stand for themselves."""
        if plain is None:
            return self.none
        return tuple(map(float, plain)) if isinstance(plain, list) else plain

    def check_numbers(self, name: str, value: Any) -> None:
        """Raise an InputError for a concrete number, or one in an array, that is out of bounds."""
        if self.rule.bounds is not None and value is not None:
            values, (low, high) = np.ravel(np.asarray(value, float)), self.rule.bounds
            if not ((values >= low) & (values <= high) | (values == self.none)).all():
                raise InputError(f"{name}={value}: expected {self.rule.expected}")


def setting(default: Any, rule: Rule, note: str = "", *, static: bool = False, recipe: bool = True, **more: Any) -> Any:
    """Declare a field as a setting, with more attributes of `Setting`; a function is called for the default.

    `static` fields of a scorer are no leaves. Fields without `recipe` change no result.
    """
    plain = None if default == more.get("none") else [*default] if isinstance(default, tuple) else default
    metadata = {_KEY: Setting(plain, rule, note, **more), "static": static, "recipe": recipe}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def settings_of(owner: type) -> dict[str, Any]:
    """The settings of a dataclass by field; a field that is a dataclass itself is a group of settings."""
    known: dict[str, Any] = {}
    for each in fields(owner):
        if _KEY in each.metadata:
            about = each.metadata[_KEY]
            known[each.name] = replace(about, default=about.default()) if callable(about.default) else about
        elif is_dataclass(each.default):
            known[each.name] = settings_of(type(each.default))
    return known


def default_values(known: Mapping[str, Any]) -> dict[str, Any]:
    """Plain defaults of settings, those of groups nested."""
    return {name: each.default if isinstance(each, Setting) else default_values(each) for name, each in known.items()}


def group() -> Any:
    """Declare a field that holds the settings of a choice by name, which its owner checks."""
    return field(default_factory=dict, metadata={_GROUP: True})


def from_values(owner: type[Owner], values: Mapping[str, Any], prefix: str = "") -> Owner:
    """A dataclass of settings from plain values by name, which stand behind `prefix` in errors."""
    known = {each.name: each for each in _declared(owner)}
    members = dict(values)
    for name, value in values.items():
        if name not in known:
            raise InputError(f"{prefix}{name}: unknown setting; expected one of {', '.join(known)}")
        if is_dataclass(default := known[name].default):
            if not isinstance(value, Mapping):
                raise InputError(f"{prefix}{name}={value}: this is a group of settings; set one of its members")
            members[name] = from_values(type(default), value, f"{prefix}{name}.")
    try:
        return owner(**members)
    except InputError as error:
        raise InputError(f"{prefix}{error}") from error


def to_values(settings: Any) -> dict[str, Any]:
    """Plain values of a dataclass of settings, as `from_values` takes them."""
    values = {each.name: getattr(settings, each.name) for each in _declared(settings)}
    return {name: to_values(value) if is_dataclass(value) else value for name, value in values.items()}


def _declared(owner: Any) -> list[Field[Any]]:
    return [each for each in fields(owner) if {_KEY, _GROUP} & {*each.metadata} or is_dataclass(each.default)]


def check_values(known: Mapping[str, Setting], values: Mapping[str, Any], prefix: str) -> None:
    """Raise an InputError for a value that its setting does not allow, or without one."""
    for name, value in values.items():
        if name not in known:
            raise InputError(f"{prefix}{name}: unknown setting; expected one of {', '.join(known)}")
        known[name].rule.check(f"{prefix}{name}", value)


def check_fields(owner: Any) -> None:
    """Raise an InputError for a field whose value its rule does not allow; arrays are not looked at."""
    plain = bool | int | float | np.integer | str | list | Mapping | None
    for each in fields(owner):
        value, about = getattr(owner, each.name), each.metadata.get(_KEY)
        if about is None:
            continue
        if callable(each.default) and not callable(value):  # words are for the command line
            raise InputError(f"{each.name}={value!r}: expected a weight such as RatioWeight()")
        parts = value if isinstance(value, list | tuple) else (value,)
        if all(isinstance(part, plain) for part in parts) and (about.none is None or value != about.none):
            about.rule.check(each.name, value)
