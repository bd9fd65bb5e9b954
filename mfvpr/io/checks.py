"""Checks of numbers and arrays from other programs."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped

from mfvpr.utils.errors import InputError

Lengths = Literal["unit", "normalize", "keep"]
TOLERANCE = 0.01  # of unit length, relative; the error of float16 is 5e-4
EXACT = 1e-6  # the error of float32


def parse_number(text: str) -> float:
    """The number in a text, as C writes it, or a `ValueError`; Python's own `float` also reads `1_0` as 10."""
    if "_" in text or not text.isascii():
        raise ValueError(f"not a number: {text!r}")
    return float(text)


def as_float32(where: str, array: Shaped[np.ndarray, "..."], kinds: str = "f") -> Float32[np.ndarray, "..."]:
    """Convert an array of these kinds of numbers (`numpy.dtype.kind`) to float32; InputError for others."""
    if array.dtype.kind not in kinds:
        raise InputError(f"{where}: expected {'floating-point ' if kinds == 'f' else ''}numbers, got {array.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(values).all():
        first = np.argwhere(~np.isfinite(values))[0].tolist()
        raise InputError(f"{where}: expected finite float32, got {array[tuple(first)]} at {first}; extract it again")
    return values


def with_length(
    where: str, descriptors: Float[np.ndarray, "rows dimensions"], lengths: Lengths
) -> Float[np.ndarray, "rows dimensions"]:
    """Check or scale the lengths of finite descriptors, see `open_features`; the result is float32."""
    if lengths == "keep" or not len(descriptors):
        return descriptors
    norms = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64))
    if lengths == "unit":
        worst = int(np.abs(norms - 1).argmax())
        if abs(norms[worst] - 1) > TOLERANCE:
            raise InputError(
                f"{where}: expected unit length, got length {norms[worst]:.4g} at {worst}; set lengths='normalize' to "
                "scale descriptors, or lengths='keep' to keep them"
            )
    elif not norms.all():
        raise InputError(f"{where}: expected descriptors with a direction, got zeros at {int(norms.argmin())}")
    scale = np.where(np.abs(norms - 1) > EXACT, norms, 1.0)  # unit length in float32: no bit changes
    return (descriptors / scale[:, None]).astype(np.float32)


def convert_floats(where: str, values: Shaped[np.ndarray, "*shape"], half: bool) -> Float[np.ndarray, "*shape"]:
    """Convert to float32, or to float16 if `half`; InputError for a value that is not finite in float16."""
    if not half:
        return np.asarray(values, np.float32)
    with np.errstate(over="ignore"):
        halves = np.asarray(values, np.float16)
    if not np.isfinite(halves).all():
        raise InputError(f"{where}: expected values that float16 holds (up to 65504), got others; write float32")
    return halves
