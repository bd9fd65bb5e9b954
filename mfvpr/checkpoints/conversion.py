"""Convert the tensors of published checkpoints to the parameters of our networks, by one table per network.

The conversion is strict: each key is used once or listed as ignored, each parameter is set once, and all types and
shapes are checked. The error counts the problems by kind, with an example of each.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from mfvpr.io.containers import shorten
from mfvpr.utils.errors import InputError


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
    origin: dict[str, str] = {}
    problems: dict[str, list[str]] = defaultdict(list)

    for key, value in source.items():
        if is_ignored(key, table):
            for pattern, shape in table.expected.items():
                if re.fullmatch(pattern, key) and value.shape != shape:
                    problems["of another shape"].append(f"{key}: expected {shape}, got {value.shape}")
            continue
        targets = _targets(key, table)
        target, layout = targets[0] if targets else ("", Layout.COPY)
        if len(targets) > 1:
            problems["with several rules"].append(shorten(key))
        elif target not in shapes:
            problems["unknown"].append(shorten(key))
        elif target in origin:
            problems["twice"].append(f"{key} and {origin[target]}")
        else:
            origin[target] = key
            parameters[target] = _convert_tensor(key, value, layout, shapes[target], problems)
    problems |= {"missing": missing} if (missing := [target for target in shapes if target not in origin]) else {}
    if problems:
        kinds = (f"{len(examples)} {kind} ({examples[0]})" for kind, examples in problems.items())
        raise InputError(f"keys do not fit the network: {', '.join(kinds)}")
    return parameters


def _convert_tensor(
    key: str, value: np.ndarray, layout: Layout, shape: tuple[int, ...], problems: Mapping[str, list[str]]
) -> np.ndarray:
    """The parameter of this shape; a tensor that does not fit is added to the problems."""
    if layout.value.first_pixel and value.ndim:
        value = value[(0,) * (value.ndim - 1)]
    expected = _source_shape(shape, layout)
    if _significant_shape(value.shape, layout) != expected:
        problems["of another shape"].append(f"{key}: expected {expected}, got {value.shape}")
    elif value.dtype not in (np.float32, np.float64):
        problems["of another type"].append(f"{key}: expected float32 or float64, got {value.dtype}")
    else:
        axes = layout.value.axes or range(len(expected))
        ordered = value.reshape(expected).transpose(axes)
        return (layout.value.sign * np.array(ordered, np.float32, order="C")).reshape(shape)
    return value


def known_share(keys: Sequence[str], table: Table) -> float:
    """Share of the keys that the table names, from 0 to 1; 0 if the table ignores all of them."""
    used = {key for key in keys if _targets(key, table)}
    return sum(key in used or is_ignored(key, table) for key in keys) / len(keys) if used else 0.0


def is_ignored(key: str, table: Table) -> bool:
    """Whether the network does not need the tensor of this key."""
    return any(re.fullmatch(pattern, key) for pattern in table.ignored)


def _targets(key: str, table: Table) -> list[tuple[str, Layout]]:
    matches = ((re.fullmatch(rule.source, key), rule) for rule in table.rules)
    return [(match.expand(rule.target), rule.layout) for match, rule in matches if match]


def _significant_shape(shape: tuple[int, ...], layout: Layout) -> tuple[int, ...]:
    return tuple(side for side in shape if side != 1) if layout.value.squeezed else shape


def _source_shape(shape: tuple[int, ...], layout: Layout) -> tuple[int, ...]:
    """Shape in the checkpoint of a parameter of this shape."""
    shape, axes = _significant_shape(shape, layout), layout.value.axes
    return shape if axes is None else tuple(shape[axes.index(axis)] for axis in range(len(shape)))
