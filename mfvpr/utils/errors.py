"""What a user got wrong, as opposed to what we did."""

from typing import Any, get_args


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what, expected, got, and the mend."""


class NoGradientError(InputError):
    """A derivative of what has none was asked for."""


def require_word(name: str, word: Any, words: Any) -> None:
    """Refuse an argument that is none of the words of a `Literal`."""
    if word not in get_args(words):
        raise InputError(f"{name}={word!r}: expected one of {', '.join(get_args(words))}")
