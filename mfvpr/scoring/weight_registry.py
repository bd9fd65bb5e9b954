"""Match weights by name: fixed weights, learned weights of the package, and files of the user."""

import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from mfvpr.scoring.weight_files import SUFFIX, read_weight
from mfvpr.scoring.weights import WEIGHTS, Weight
from mfvpr.utils.errors import InputError

_LEARNED = Path(__file__).parent / "learned"


class _NamedWeights(Mapping[str, Weight]):
    """Weights by name; files are read on access, and the same name returns the same object."""

    def __getitem__(self, name: Any) -> Weight:
        return WEIGHTS[name] if name in WEIGHTS else _read_by_name(name)[0]

    def __iter__(self) -> Iterator[str]:
        return iter([*WEIGHTS, *_learned_files()])

    def __len__(self) -> int:
        return len(WEIGHTS) + len(_learned_files())


@cache
def _learned_files() -> dict[str, Path]:
    return {path.stem: path for path in sorted(_LEARNED.glob(f"*{SUFFIX}"))}


def provenance(name: str) -> dict[str, Any]:
    """Provenance of a learned weight, as `write_weight` stored it; empty for a fixed weight."""
    return {} if name in WEIGHTS else _read_by_name(name)[1]


def _read_by_name(name: Any) -> tuple[Weight, dict[str, Any]]:
    if name in _learned_files():
        return _read(_learned_files()[name], 0)
    if isinstance(name, str) and name.endswith(SUFFIX):
        path = Path(os.path.expanduser(name))
        return _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    raise KeyError(name)


@cache
def _read(path: Path, modified_ns: int) -> tuple[Weight, dict[str, Any]]:
    """Contents of a file; `modified_ns` makes a modified file a new entry of the cache."""
    return read_weight(path)


NAMED_WEIGHTS: Mapping[str, Weight] = _NamedWeights()
"""Weights by word, or by the path `*.json` of a file that `mfvpr learn` wrote (InputError for other files)."""


def named_weight(weight: Weight | str) -> Weight:
    """The weight that a word or the path of a file stands for; any other weight as it is."""
    if isinstance(weight, str) and weight not in NAMED_WEIGHTS:
        raise InputError(f"weight={weight!r}: expected one of {', '.join(NAMED_WEIGHTS)}, or FILE{SUFFIX}")
    return NAMED_WEIGHTS[weight] if isinstance(weight, str) else weight
