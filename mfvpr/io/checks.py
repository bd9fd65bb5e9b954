"""What arrays of other programs must be before they are used."""

from typing import Literal

import numpy as np

from mfvpr.utils.errors import InputError

Lengths = Literal["unit", "normalize", "keep"]
LENGTHS = ("unit", "normalize", "keep")
TOLERANCE = 0.01  # of unit length, relative: float16 loses 5e-4
EXACT = 1e-6  # what float32 loses


def require_lengths(lengths: str) -> None:
    """Refuse a word that says nothing about lengths."""
    if lengths not in LENGTHS:
        raise InputError(f"lengths={lengths}: expected one of {', '.join(LENGTHS)}")


def as_float32(where: str, array: np.ndarray, kinds: str = "f") -> np.ndarray:
    """Finite float32 from an array of these kinds of numbers (`numpy.dtype.kind`).

    Raises:
        InputError: of another type, or not finite.
    """
    if array.dtype.kind not in kinds:
        raise InputError(f"{where}: expected {'floating-point ' if kinds == 'f' else ''}numbers, got {array.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(values).all():
        first = np.argwhere(~np.isfinite(values))[0].tolist()
        raise InputError(f"{where}: expected finite float32, got {array[tuple(first)]} at {first}; extract it again")
    return values


def with_length(where: str, descriptors: np.ndarray, lengths: Lengths) -> np.ndarray:
    """Descriptors `[N, D]` float32 of the length that was asked for.

    Args:
        where: for messages.
        descriptors: finite.
        lengths: `unit`: they have unit length but for rounding, which is mended; `normalize`: give them unit length;
            `keep`: as they are.

    Raises:
        InputError: off unit length by more than 1 %, or of no length to normalize.
    """
    if lengths == "keep" or not len(descriptors):
        return descriptors
    norms = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64))
    if lengths == "unit":
        worst = int(np.abs(norms - 1).argmax())
        if abs(norms[worst] - 1) > TOLERANCE:
            raise InputError(
                f"{where}: expected descriptors of unit length, got length {norms[worst]:.4g} at {worst}; "
                "lengths='normalize' gives them unit length, lengths='keep' takes them as they are"
            )
    elif not norms.all():
        raise InputError(f"{where}: expected descriptors with a direction, got zeros at {int(norms.argmin())}")
    scale = np.where(np.abs(norms - 1) > EXACT, norms, 1.0)  # what is of unit length comes back bit by bit
    return (descriptors / scale[:, None]).astype(np.float32)
