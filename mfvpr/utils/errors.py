"""Errors of the user's input, as opposed to errors of this library."""

from typing import Any, get_args


class InputError(ValueError):
    """Input that cannot be used. The message is one line: argument, expected, got, and how to fix it."""


class NoGradientError(InputError):
    """A derivative of a function that has none."""


def require_word(name: str, word: Any, words: Any) -> None:
    """Refuse an argument that is not among the words of a `Literal`."""
    if word not in get_args(words):
        raise InputError(f"{name}={word!r}: expected one of {', '.join(get_args(words))}")


def require_type(name: str, value: Any, kind: type, example: str) -> None:
    """Refuse an argument of another type."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected a {kind.__name__}, such as {example}, got {value!r:.60}")
