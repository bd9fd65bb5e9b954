"""Numbers in text files of other programs."""


def parse_number(text: str) -> float:
    """The number in a text, as C writes it, or a `ValueError`; Python's own `float` also reads `1_0` as 10."""
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)
