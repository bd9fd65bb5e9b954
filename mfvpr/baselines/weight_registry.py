"""Match weights by name: fixed weights, learned weights of the package, and files of the user.

A learned weight is a small JSON file with its provenance.
"""

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mfvpr.baselines.learned_weight import INPUTS, LearnedWeight
from mfvpr.core.weights import WEIGHTS, Weight
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file, require_replaceable, write_text

SUFFIX = ".json"
_FORMAT = "mfvpr match weight 1"
_LEARNED = Path(__file__).parent / "learned"


def write_weight(path: Path | str, weight: LearnedWeight, provenance: Mapping[str, Any]) -> None:
    """Write a weight of finite numbers as JSON, exact to the last bit, with its provenance (JSON values).

    An earlier file of a weight is replaced; an InputError for other files.
    """
    require_replaceable(Path(path), _FORMAT.encode())
    arrays = {f.name: np.asarray(getattr(weight, f.name)).tolist() for f in fields(weight) if f.name != "names"}
    content = {"format": _FORMAT, "made": provenance, "inputs": list(weight.names), **arrays}
    write_text(Path(path), json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_weight(path: Path | str) -> tuple[LearnedWeight, dict[str, Any]]:
    """Weight and provenance from a file of `write_weight`, exact to the last bit; an InputError for other files."""
    path = Path(path)
    require_file(path, "a match weight that mfvpr learn wrote")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format") != _FORMAT:
            raise ValueError("another format")
        return _weight(content.pop("inputs"), content), dict(content["made"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: expected a match weight that mfvpr learn wrote ({reason})") from error


def _weight(names: list[str], content: Mapping[str, Any]) -> LearnedWeight:
    plain = {f.name: np.array(content[f.name]) for f in fields(LearnedWeight) if f.name != "names"}
    if words := [name for name, values in plain.items() if values.dtype.kind not in "fi"]:
        raise ValueError(f"{words[0]}: expected numbers")
    with np.errstate(over="ignore"):
        arrays = {name: values.astype(np.float32) for name, values in plain.items()}
    inputs, hidden = len(names), arrays["output"].size
    shapes = {
        "center": (inputs,),
        "scale": (inputs,),
        "hidden": (inputs, hidden),
        "hidden_bias": (hidden,),
        "output": (hidden,),
        "output_bias": (),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} of shape {list(arrays[name].shape)}, expected finite numbers {list(shape)}")
    known = isinstance(names, list) and {*names} <= {*INPUTS} and len({*names}) == len(names) > 0
    if not known or arrays["scale"].min() < np.finfo(np.float32).tiny:
        raise ValueError(f"inputs {names}, scale {arrays['scale'].tolist()}")
    return LearnedWeight(**{name: jnp.asarray(values, dtype=float) for name, values in arrays.items()}, names=(*names,))


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
