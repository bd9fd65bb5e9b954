"""Settings: fields of frozen dataclasses with a default, the allowed values, and a sentence.

    @dataclass(frozen=True)
    class Sift:
        max_keypoints: int | None = setting(800, whole(1, 20_000) | None, "the highest scores are kept; null = all")

        def __post_init__(self) -> None:
            check_fields(self)

Programs make their settings, and what `--help` says about them, from these fields.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from typing import Any, TypeVar, get_args

import numpy as np

from mfvpr.utils.errors import InputError

REQUIRED = "???"  # the default of a setting without one, in Hydra's words
_KEY, _GROUP = "setting", "group"  # of the field's metadata
_MAX_SHOWN = 200  # characters of a value in an error
Owner = TypeVar("Owner")


@dataclass(frozen=True)
class Rule:
    """The allowed values of a setting, and the same in words; `rule | word` allows a word, or None, as well."""

    holds: Callable[[Any], bool]
    expected: str

    def __or__(self, other: Any) -> "Rule":
        if not isinstance(other, Rule):
            other = one_of(other)
        words = f"{self.expected}, or {other.expected.removeprefix('one of ')}"
        return Rule(lambda value: self.holds(value) or other.holds(value), words)

    def check(self, name: str, value: Any) -> None:
        """Raise an InputError for a value that is not allowed."""
        if not self.holds(value):
            text = "null" if value is None else str(value)
            text = text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN // 2]}..."
            raise InputError(f"{name}={text}: expected {self.expected}")


def one_of(*choices: Any) -> Rule:
    """Some words, numbers, flags or None."""
    words = (
        "null" if choice is None else str(choice).lower() if isinstance(choice, bool) else str(choice)
        for choice in choices
    )
    return Rule(
        lambda value: any(type(value) is type(choice) and value == choice for choice in choices),
        "one of " + ", ".join(words),
    )


def word_of(words: Any) -> Rule:
    """A word of a `Literal`."""
    return one_of(*get_args(words))


def text(pattern: str = r"(?s).+", expected: str = "text") -> Rule:
    """Text that matches a regular expression."""
    return Rule(lambda value: isinstance(value, str) and bool(re.fullmatch(pattern, value)), expected)


def number(low: float, high: float) -> Rule:
    """A number in a range, its ends included."""

    def holds(value: Any) -> bool:
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        return is_number and bool(low <= value <= high)

    return Rule(holds, f"a number from {low:g} to {high:g}")


def whole(low: int, high: int) -> Rule:
    """An integer in a range, its ends included."""

    def holds(value: Any) -> bool:
        return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(low <= value <= high)

    return Rule(holds, f"a whole number from {low} to {high}")


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of a given length, or of any above 0."""

    def holds(value: Any) -> bool:
        has_length = isinstance(value, list | tuple) and (len(value) == length if length else bool(value))
        return has_length and all(map(rule.holds, value))

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def or_list(rule: Rule) -> Rule:
    """A value that a rule allows, or a list of such values."""
    several = list_of(rule)
    return Rule(lambda value: rule.holds(value) or several.holds(value), f"{rule.expected}, or a list of them")


FLAG = one_of(True, False)
POSITIVE = number(1e-6, 1e12)  # beyond these bounds float32 and int32 would fail silently
NOT_NEGATIVE = number(0, 1e12)
COUNT = whole(1, 10**6)
INDEX = whole(0, 10**6)
SIZE = list_of(whole(16, 4096), 2)
SHAPED_SIZE = "width, height; auto: the shape of the first database image, at as many pixels; a number: at so many"
TEXT = text()
PATH = text(r"(?s)(?!.*\$\{).+", "a path with variables filled in")


@dataclass(frozen=True)
class Setting:
    """A setting that programs offer: its default as a plain value, the allowed values, and a sentence."""

    default: Any
    rule: Rule
    note: str = ""


def setting(default: Any, rule: Rule, note: str = "", **metadata: Any) -> Any:
    """Declare a field as a setting; a function is called for the default. `metadata` are those of other readers."""
    metadata[_KEY] = rule, note
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


def settings_of(owner: type) -> dict[str, Setting | dict[str, Any]]:
    """The settings of a dataclass by field; a field that is a dataclass itself is a group of settings."""
    known: dict[str, Any] = {}
    for each in fields(owner):
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if _KEY in each.metadata:
            rule, note = each.metadata[_KEY]
            known[each.name] = Setting([*default] if isinstance(default, tuple) else default, rule, note)
        elif is_dataclass(default):
            known[each.name] = settings_of(type(default))
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
    for each in fields(owner):
        value = getattr(owner, each.name)
        if _KEY in each.metadata and isinstance(value, bool | int | float | str | list | tuple | Mapping | None):
            each.metadata[_KEY][0].check(each.name, value)
