"""What a user got wrong, as opposed to what we did."""


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what, expected, got, and the mend."""
