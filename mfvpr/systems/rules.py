"""Rules of settings: a test of the value, and the words of the error."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """A test of a setting's value, and what it expects in words."""

    holds: Callable[[Any], bool]
    expected: str


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


def number(low: float, high: float) -> Rule:
    """A number in a range, its ends included."""
    return Rule(
        lambda value: type(value) in (int, float) and low <= value <= high,
        f"a number from {low:g} to {high:g}",
    )


def whole(low: int, high: int) -> Rule:
    """An integer in a range, its ends included."""
    return Rule(
        lambda value: type(value) is int and low <= value <= high,
        f"a whole number from {low} to {high}",
    )


def list_of(rule: Rule, length: int = 0) -> Rule:
    """A list of values that a rule allows, of a given length, or of any above 0."""

    def holds(value: Any) -> bool:
        has_length = isinstance(value, list) and (len(value) == length if length else bool(value))
        return has_length and all(map(rule.holds, value))

    return Rule(holds, f"a list of {length or 'one or more'}, each {rule.expected}")


def any_of(expected: str, *rules: Rule) -> Rule:
    """A value that one of several rules allows."""
    return Rule(lambda value: any(rule.holds(value) for rule in rules), expected)


def either(rule: Rule, *choices: Any) -> Rule:
    """A value that a rule allows, or one of some choices."""
    other = one_of(*choices)
    return any_of(f"{rule.expected}, or {other.expected.removeprefix('one of ')}", rule, other)


def or_list(rule: Rule) -> Rule:
    """A value that a rule allows, or a list of such values."""
    return any_of(f"{rule.expected}, or a list of them", rule, list_of(rule))
