"""Convert the tensors of published checkpoints to the parameters of our networks, by one table per network.

The conversion is strict: each key is used once or listed as ignored, each parameter is set once, and all types and
shapes are checked.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError

_MOST_EXAMPLES = 3  # of problems in a message


class _Change(NamedTuple):
    axes: tuple[int, ...] | None = None  # of the source, in our order
    squeezed: bool = False  # whether to ignore axes of length 1 in both shapes
    sign: int = 1
    first_pixel: bool = False  # of an image with equal pixels


class Layout(Enum):
    """Change of an array from its file's convention to ours."""

    COPY = _Change()
    CONV = _Change((2, 3, 1, 0))  # OIHW -> HWIO
    UPSAMPLING = _Change((2, 3, 0, 1))  # a transposed convolution's IOHW -> HWIO
    LINEAR = _Change((1, 0))  # (out, in) -> (in, out)
    POINTWISE = _Change((1, 0), squeezed=True)  # (out, in, 1, 1) -> (in, out), or (1, 1, in, out)
    SQUEEZED = _Change(squeezed=True)  # (1, O, 1, 1) and the like -> (O,)
    OPPOSITE = _Change((1, 0), squeezed=True, sign=-1)  # (in, out) of the other sign -> (out, in)
    PIXEL = _Change(first_pixel=True)  # (H, W, C) -> (C,)


class Rule(NamedTuple):
    """Assign keys that fully match `source`, a regular expression, to `target`, a dotted path with its groups."""

    source: str
    target: str
    layout: Layout = Layout.COPY


@dataclass(frozen=True)
class Table:
    """Rules for all keys of a network's checkpoint."""

    rules: tuple[Rule, ...]
    ignored: tuple[str, ...] = ()  # patterns of keys that the network does not need
    # Pattern -> required shape of ignored keys that identify this network's checkpoint.
    expected: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


def convert(
    source: Mapping[str, np.ndarray], table: Table, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Convert a checkpoint's tensors to parameters by dotted path, float32 (float64 is rounded).

    `source` has the tensors by their keys, `shapes` those of the network's parameters by dotted path.

    Raises:
        InputError: keys are missing or unknown, or a tensor has another shape or type.
    """
    parameters: dict[str, np.ndarray] = {}
    problems: list[str] = []
    for key, value in source.items():
        if any(re.fullmatch(pattern, key) for pattern in table.ignored):
            for pattern, shape in table.expected.items():
                if re.fullmatch(pattern, key) and value.shape != shape:
                    problems.append(f"{key} of another shape: expected {shape}, got {value.shape}")
            continue
        rules = [(match, rule) for rule in table.rules if (match := re.fullmatch(rule.source, key))]
        target = rules[0][0].expand(rules[0][1].target) if len(rules) == 1 else ""
        if target not in shapes or target in parameters:
            problems.append(f"{shorten(key)} {'twice' if target in parameters else 'unknown'}")
            continue
        parameters[target], problem = _convert_tensor(value, rules[0][1].layout, shapes[target])
        problems += [f"{key} {problem}"] if problem else []
    problems += [f"{target} missing" for target in shapes if target not in parameters]
    if problems:
        examples = "; ".join(problems[:_MOST_EXAMPLES])
        raise InputError(f"keys do not fit the network in {len(problems)} places: {examples}")
    return parameters


def _convert_tensor(value: np.ndarray, layout: Layout, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """The parameter of this shape, and what does not fit in a tensor."""
    change = layout.value
    if change.first_pixel and value.ndim:
        value = value[(0,) * (value.ndim - 1)]
    significant, got = (
        tuple(side for side in each if side != 1 or not change.squeezed) for each in (shape, value.shape)
    )
    axes = change.axes or tuple(range(len(significant)))
    expected = tuple(significant[axes.index(axis)] for axis in range(len(significant)))
    if got != expected:
        return value, f"of another shape: expected {expected}, got {value.shape}"
    if value.dtype not in (np.float32, np.float64):
        return value, f"of another type: expected float32 or float64, got {value.dtype}"
    ordered = value.reshape(expected).transpose(axes)
    return (change.sign * np.array(ordered, np.float32, order="C")).reshape(shape), ""
