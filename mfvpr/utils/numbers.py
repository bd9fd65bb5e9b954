"""Numbers in text files of other programs."""


def parse_number(text: str) -> float:
    """The number in a text, as C and other languages write it; Python's own `float` also reads `1_0` as 10.

    Raises:
        ValueError: the text is no such number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)
