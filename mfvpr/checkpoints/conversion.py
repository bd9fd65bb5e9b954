"""Foreign checkpoints -> our parameters: one table per network, one converter for all.

Nothing is guessed and nothing is left over: every source key is used once or listed as ignored, every target is filled
once, every type and shape is checked. What is wrong is counted by kind, with an example of each.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from mfvpr.io.formats.pickles import excerpt
from mfvpr.utils.errors import InputError


class _Change(NamedTuple):
    axes: tuple[int, ...] | None = None  # of the source, in our order
    squeezed: bool = False  # whether axes of length 1 mean nothing, there and here
    sign: int = 1
    first_pixel: bool = False  # of an image that is alike everywhere


class Layout(Enum):
    """How arrays are changed from their file's convention to ours."""

    COPY = _Change()
    CONV = _Change((2, 3, 1, 0))  # OIHW -> HWIO
    UPSAMPLING = _Change((2, 3, 0, 1))  # a transposed convolution's IOHW -> HWIO
    LINEAR = _Change((1, 0))  # (out, in) -> (in, out)
    POINTWISE = _Change((1, 0), squeezed=True)  # (out, in, 1, 1) -> (in, out), or (1, 1, in, out)
    SQUEEZED = _Change(squeezed=True)  # (1, O, 1, 1) and the like -> (O,)
    OPPOSITE = _Change((1, 0), squeezed=True, sign=-1)  # (in, out) of the other sign -> (out, in)
    PIXEL = _Change(first_pixel=True)  # (H, W, C) -> (C,)


class Rule(NamedTuple):
    """Source keys that match `source` (whole, a regular expression) go to `target`, a dotted path with its groups."""

    source: str
    target: str
    layout: Layout = Layout.COPY


@dataclass(frozen=True)
class Table:
    """All keys of a network's checkpoint.

    Args:
        rules: where they go.
        ignored: patterns of keys that the network does not need.
        expected: patterns of those among them whose shape tells whether it is this network's checkpoint.
    """

    rules: tuple[Rule, ...]
    ignored: tuple[str, ...] = ()
    expected: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


def convert(
    source: Mapping[str, np.ndarray], table: Table, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Parameters by dotted path, float32 (float64 is rounded), from a checkpoint's tensors.

    Args:
        source: tensors by their keys in the checkpoint.
        table: of the network.
        shapes: what the network expects, by dotted path.

    Raises:
        InputError: keys are missing, left over, or of another shape or type.
    """
    found: dict[str, np.ndarray] = {}
    origin: dict[str, str] = {}
    problems: dict[str, list[str]] = {}

    def wrong(kind: str, example: str) -> None:
        problems.setdefault(kind, []).append(example)

    for key, value in source.items():
        if is_ignored(key, table):
            for pattern, shape in table.expected.items():
                if re.fullmatch(pattern, key) and value.shape != shape:
                    wrong("of another shape", f"{key}: expected {shape}, got {value.shape}")
            continue
        targets = _targets(key, table)
        if len(targets) > 1:
            wrong("with several rules", excerpt(key))
            continue
        if not targets or targets[0][0] not in shapes:
            wrong("unknown", excerpt(key))
            continue
        target, layout = targets[0]
        if target in origin:
            wrong("twice", f"{key} and {origin[target]}")
            continue
        origin[target] = key
        if layout.value.first_pixel and value.ndim:
            value = value[(0,) * (value.ndim - 1)]
        expected = _source_shape(shapes[target], layout)
        if _compared(value.shape, layout) != expected:
            wrong("of another shape", f"{key}: expected {expected}, got {value.shape}")
        elif value.dtype not in (np.float32, np.float64):
            wrong("of another type", f"{key}: expected float32 or float64, got {value.dtype}")
        else:
            found[target] = _laid_out(value.reshape(expected), layout).reshape(shapes[target])
    for target in shapes:
        if target not in origin:
            wrong("missing", target)
    if problems:
        kinds = (f"{len(examples)} {kind} ({examples[0]})" for kind, examples in problems.items())
        raise InputError(f"keys do not fit the network: {', '.join(kinds)}")
    return found


def share_known(keys: Sequence[str], table: Table) -> float:
    """How many of the keys the table names, from 0 to 1; 0 where all of these are ignored."""
    used, ignored = ([test(key, table) for key in keys] for test in (_targets, is_ignored))
    return sum(map(any, zip(used, ignored, strict=True))) / len(used) if any(used) else 0.0


def is_ignored(key: str, table: Table) -> bool:
    """Whether the network does not need this tensor of its checkpoint."""
    return any(re.fullmatch(pattern, key) for pattern in table.ignored)


def _targets(key: str, table: Table) -> list[tuple[str, Layout]]:
    matches = ((re.fullmatch(rule.source, key), rule) for rule in table.rules)
    return [(match.expand(rule.target), rule.layout) for match, rule in matches if match]


def _laid_out(array: np.ndarray, layout: Layout) -> np.ndarray:
    """The array in our layout, contiguous float32."""
    axes, sign = layout.value.axes, layout.value.sign
    ordered = np.array(array if axes is None else array.transpose(axes), np.float32, order="C")
    return ordered if sign == 1 else np.negative(ordered)


def _compared(shape: tuple[int, ...], layout: Layout) -> tuple[int, ...]:
    """The shape, without axes of length 1 where they mean nothing."""
    return tuple(side for side in shape if side != 1) if layout.value.squeezed else shape


def _source_shape(shape: tuple[int, ...], layout: Layout) -> tuple[int, ...]:
    """The checkpoint's shape of what is `shape` here."""
    shape, axes = _compared(shape, layout), layout.value.axes
    return shape if axes is None else tuple(shape[axes.index(axis)] for axis in range(len(shape)))
