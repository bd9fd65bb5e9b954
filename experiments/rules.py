"""Rules of settings: a test of the value, and the words of the error."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """A test of a setting's value, and what it expects in words."""

    holds: Callable[[Any], bool]
    expected: str


def is_count(value: Any) -> bool:
    """Whether a value is an integer, and no flag."""
    return isinstance(value, int) and not isinstance(value, bool)


def pattern(regex: str, expected: str) -> Rule:
    """Text that matches a regular expression."""
    return Rule(lambda value: isinstance(value, str) and bool(re.fullmatch(regex, value)), expected)


def one_of(*choices: Any) -> Rule:
    """One of some words, numbers, flags or null."""
    words = ("null" if choice is None else str(choice).lower() if isinstance(choice, bool) else str(choice)
             for choice in choices)  # fmt: skip
    return Rule(
        lambda value: any(type(value) is type(choice) and value == choice for choice in choices),
        "one of " + ", ".join(words),
    )


def either(rule: Rule, *choices: Any) -> Rule:
    """A value that a rule allows, or one of some choices."""
    other = one_of(*choices)
    words = other.expected.removeprefix("one of ")
    return Rule(lambda value: rule.holds(value) or other.holds(value), f"{rule.expected}, or {words}")


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of a given length, or of any above 0."""

    def holds(value: Any) -> bool:
        has_length = isinstance(value, list) and (len(value) == length if length else bool(value))
        return has_length and all(map(rule.holds, value))

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def number(low: float, high: float) -> Rule:
    """A number in a range, its ends included."""
    words = {
        (1e-6, 1e12): "a number above 0 (1e-6 to 1e12)",
        (1e-6, 2): "a number above 0 and at most 2",
        (0, 1e12): "a number not below 0 (at most 1e12)",
    }.get((low, high), f"a number from {low:g} to {high:g}")
    return Rule(
        lambda value: isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high, words
    )


def between(low: int, high: int) -> Rule:
    """An integer in a range, its ends included."""
    return Rule(lambda value: is_count(value) and low <= value <= high, f"a whole number from {low} to {high}")


def or_list(rule: Rule) -> Rule:
    """A value that a rule allows, or a list of such values."""
    listed = list_of(rule)
    return Rule(lambda value: rule.holds(value) or listed.holds(value), f"{rule.expected}, or a list of them")


def or_file(rule: Rule, suffix: str) -> Rule:
    """A value that a rule allows, or the path of a file with a suffix."""
    return Rule(
        lambda value: rule.holds(value) or (isinstance(value, str) and value.endswith(suffix)),
        f"{rule.expected}, or a file that ends in {suffix}",
    )


def axis(rule: Rule) -> Rule:
    """The values of one parameter in a grid, or null."""
    listed = list_of(rule)
    return Rule(
        lambda value: value is None or listed.holds(value), f"{listed.expected}; null is the scorer's own value"
    )
