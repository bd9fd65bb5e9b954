"""Foreign checkpoints -> our parameters: one table per network, one converter for all.

Nothing is guessed and nothing is left over: every source key is used once or listed as ignored, every target is filled
once, every shape is checked, and all that is wrong is told together.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from mfvpr.errors import InputError


class Layout(Enum):
    """How axes are reordered from torch's convention to JAX's."""

    COPY = None
    CONV = (2, 3, 1, 0)  # OIHW -> HWIO
    LINEAR = (1, 0)  # (out, in) -> (in, out)


class Rule(NamedTuple):
    """Source keys that match `source` (whole, a regular expression) go to `target`, a dotted path with its groups."""

    source: str
    target: str
    layout: Layout = Layout.COPY


@dataclass(frozen=True)
class Table:
    """All keys of a network's checkpoint; `ignored` are patterns of keys that hold no parameters."""

    rules: tuple[Rule, ...]
    ignored: tuple[str, ...] = ()


def convert(
    source: Mapping[str, np.ndarray], table: Table, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Parameters by dotted path, float32, from a checkpoint's tensors.

    Args:
        source: tensors by their keys in the checkpoint.
        table: of the network.
        shapes: what the network expects, by dotted path.

    Raises:
        InputError: keys are missing, left over, or of another shape; the message lists all of them.
    """
    found: dict[str, np.ndarray] = {}
    origin: dict[str, str] = {}
    problems: list[str] = []
    for key, value in source.items():
        if any(re.fullmatch(pattern, key) for pattern in table.ignored):
            continue
        targets = _targets(key, table)
        if len(targets) != 1 or targets[0][0] not in shapes:
            problems.append(f"unknown key {key}" if len(targets) < 2 else f"{key} matches several rules")
            continue
        target, layout = targets[0]
        if target in origin:
            problems.append(f"{key} and {origin[target]} both fill {target}")
            continue
        origin[target] = key
        array = _laid_out(np.asarray(value), layout)
        if array is None or array.shape != shapes[target]:
            wanted = _source_shape(shapes[target], layout)
            problems.append(f"{key} -> {target}: expected shape {wanted}, got {np.shape(value)}")
        else:
            found[target] = array
    problems += [f"nothing fills {target}" for target in shapes if target not in origin]
    if problems:
        raise InputError(f"{len(problems)} of the network's keys do not fit: " + "; ".join(problems))
    return found


def _targets(key: str, table: Table) -> list[tuple[str, Layout]]:
    matches = ((re.fullmatch(rule.source, key), rule) for rule in table.rules)
    return [(match.expand(rule.target), rule.layout) for match, rule in matches if match]


def _laid_out(array: np.ndarray, layout: Layout) -> np.ndarray | None:
    """The array in our layout, contiguous float32; None where it has another rank."""
    axes = layout.value
    if axes is not None:
        if array.ndim != len(axes):
            return None
        array = array.transpose(axes)
    return np.ascontiguousarray(array, np.float32).reshape(array.shape)


def _source_shape(shape: tuple[int, ...], layout: Layout) -> tuple[int, ...]:
    """The checkpoint's shape of what is `shape` here."""
    return shape if layout.value is None else tuple(shape[layout.value.index(axis)] for axis in range(len(shape)))
