"""Match weights by name: those set by hand, those that were learned and ship as files, and files of one's own."""

import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from mfvpr.scoring.weight_files import SUFFIX, read_weight
from mfvpr.scoring.weights import WEIGHTS, Weight

_LEARNED = Path(__file__).parent / "learned"


class _Named(Mapping[str, Weight]):
    """Files are read when they are asked for; the same name gives the same object, by which programs tell weights."""

    def __getitem__(self, name: Any) -> Weight:
        if name in WEIGHTS:
            return WEIGHTS[name]
        return _of_file(name)[0]

    def __iter__(self) -> Iterator[str]:
        return iter([*WEIGHTS, *_learned()])

    def __len__(self) -> int:
        return len(WEIGHTS) + len(_learned())


@cache
def _learned() -> dict[str, Path]:
    return {path.stem: path for path in sorted(_LEARNED.glob(f"*{SUFFIX}"))}


def how_made(name: str) -> dict[str, Any]:
    """How a weight was learned; empty where it was set by hand."""
    return {} if name in WEIGHTS else _of_file(name)[1]


def _of_file(name: Any) -> tuple[Weight, dict[str, Any]]:
    if name in _learned():
        return _read(_learned()[name], 0)
    if isinstance(name, str) and name.endswith(SUFFIX):
        path = Path(os.path.expanduser(name))
        return _read(path, path.stat().st_mtime_ns if path.exists() else 0)
    raise KeyError(name)


@cache
def _read(path: Path, changed: int) -> tuple[Weight, dict[str, Any]]:
    """Of a file that was changed at a time."""
    return read_weight(path)


NAMED_WEIGHTS: Mapping[str, Weight] = _Named()
"""By word, or by the path of a file that `experiments.learn` wrote, which ends in `.json` (InputError if it is not)."""
