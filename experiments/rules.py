"""Rules of settings: what a value must be, in code and in words."""

import math
import numbers
from collections.abc import Callable
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """What a setting must be, in code and in words."""

    holds: Callable[[Any], bool]
    expected: str


def _is_number(value: Any) -> bool:
    if isinstance(value, bool):
        return False
    return isinstance(value, int) or (isinstance(value, numbers.Real) and math.isfinite(value))


def is_count(value: Any) -> bool:
    """A whole number, and no flag."""
    return isinstance(value, int) and not isinstance(value, bool)


def one_of(*choices: Any) -> Rule:
    """One of some words, numbers, flags or null."""
    return Rule(lambda value: any(value is c or (value == c and type(value) is type(c)) for c in choices),
                "one of " + ", ".join("null" if c is None else str(c).lower() if isinstance(c, bool) else str(c)
                                      for c in choices))  # fmt: skip


def either(rule: Rule, *choices: Any) -> Rule:
    """What a rule allows, or one of some choices."""
    other = one_of(*choices)
    words = other.expected.removeprefix("one of ")
    return Rule(lambda value: rule.holds(value) or other.holds(value), f"{rule.expected}, or {words}")


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of any length above 0, or of one."""

    def holds(value: Any) -> bool:
        return (
            isinstance(value, list)
            and (len(value) == length if length else bool(value))
            and all(map(rule.holds, value))
        )

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def number(low: float, high: float) -> Rule:
    """A number in a range, its ends included."""
    words = {
        (1e-6, 1e12): "a number above 0 (1e-6 to 1e12)",
        (1e-6, 2): "a number above 0 and at most 2",
        (0, 1e12): "a number not below 0 (at most 1e12)",
    }.get((low, high), f"a number from {low:g} to {high:g}")
    return Rule(lambda value: _is_number(value) and low <= value <= high, words)


def between(low: int, high: int) -> Rule:
    """A whole number in a range, its ends included."""
    return Rule(lambda value: is_count(value) and low <= value <= high, f"a whole number from {low} to {high}")


def or_list(rule: Rule) -> Rule:
    """What a rule allows, or a list of that."""
    listed = list_of(rule)
    return Rule(lambda value: rule.holds(value) or listed.holds(value), f"{rule.expected}, or a list of them")


def or_file(rule: Rule, suffix: str) -> Rule:
    """What a rule allows, or the path of a file that ends so."""
    return Rule(
        lambda value: rule.holds(value) or (isinstance(value, str) and value.endswith(suffix)),
        f"{rule.expected}, or a file that ends in {suffix}",
    )


def axis(rule: Rule) -> Rule:
    """Values of a grid."""
    listed = list_of(rule)
    return Rule(
        lambda value: value is None or listed.holds(value), f"{listed.expected}; null is the scorer's own value"
    )
