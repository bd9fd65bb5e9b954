"""The axes of a sweep: values as the user writes them, and as the library takes them."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments import build
from experiments.settings import SettingsError
from mfvpr import sweeping
from mfvpr.declaration import Parameter, declared
from mfvpr.pipeline import MatchSet
from mfvpr.scoring import SCORERS, Scorer
from mfvpr.scoring.parameters import fit, with_parameters

OF_MATCHES = ("max_distance", "c")  # what is no parameter of a scorer
BYTES_PER_SETTING = 2000  # of Python's own, about
_MB = 1e6


@dataclass(frozen=True)
class Axes:
    """What is varied.

    Attributes:
        method: the scorer's name.
        values: by name, as they were written.
        own: the scorer's own value of each, as it would be written.
    """

    method: str
    values: Mapping[str, Sequence[Any]]
    own: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Settings of the grid."""
        return math.prod(map(len, self.values.values()))

    def grid(self) -> list[dict[str, Any]]:
        """Every combination, as written."""
        return sweeping.grid(self.values)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The scorer's."""
        return declared(SCORERS[self.method])

    def setting(self, written: Mapping[str, Any]) -> sweeping.Setting:
        """The values that `mfvpr.sweeping` takes."""
        return {name: self._value(name, value) for name, value in written.items()}

    def _value(self, name: str, value: Any) -> Any:
        if name == "c":
            return None if value == "auto" else float(value)
        if name == "max_distance":
            return math.inf if value is None else value
        return self.parameters[name].value(value)


def axes(settings: dict[str, Any]) -> Axes:
    """The checked axes of one scorer."""
    group = settings["scorer"]
    if "method" not in group:
        raise SettingsError("scorer=all: a sweep takes one scorer at a time; choose with scorer=histogram, or several "
                            "with -m scorer=sum,anchor,histogram")  # fmt: skip
    method = group["method"]
    known = {*declared(SCORERS[method]), *OF_MATCHES}
    values = {name: axis for name, axis in settings["grid"].items() if axis is not None}
    for name, axis in values.items():
        if name not in known:
            raise SettingsError(f"grid.{name}: scorer={method} has no such parameter; it has "
                                f"{', '.join(n for n in settings['grid'] if n in known)}")  # fmt: skip
        if len(set(axis)) < len(axis):
            raise SettingsError(f"grid.{name}={axis}: expected different values")
    if not values:
        raise SettingsError("grid: expected at least one axis, such as 'grid.sigma=[10,22.5]', or an experiment=; see "
                            "--help")  # fmt: skip
    own = {name: _own(settings, name) for name in values}
    return Axes(method, values, own)


def _own(settings: dict[str, Any], name: str) -> Any:
    if name == "c":
        return settings["fusion"]["c"]
    return settings["matching"]["max_distance"] if name == "max_distance" else settings["scorer"].get(name)


def scorer(settings: dict[str, Any]) -> Scorer:
    """The scorer whose parameters are varied."""
    return next(iter(build.scorers(settings["scorer"]).values()))


def require_memory(what: str, needed: int, mend: str) -> None:
    """Refuse what would not fit, before it is begun."""
    free = _free_memory()
    if needed > 0.8 * free:
        raise SettingsError(
            f"{what} would take about {needed / _MB:,.0f} MB of memory, {free / _MB:,.0f} MB are free; {mend}"
        )


def _free_memory() -> int:
    """Bytes that a program may still take, those of cached files included; all of them where the system is silent."""
    try:
        return 1024 * int(re.findall(r"MemAvailable: *(\d+)", Path("/proc/meminfo").read_text())[0])
    except (OSError, IndexError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def require_bins(settings: dict[str, Any], varied: Axes, matches: MatchSet) -> None:
    """Refuse before any work what would be refused when its turn comes: histograms of more bins than there may be."""
    sizes = {name: varied.values[name] for name in ("bin_size", "align") if name in varied.values}
    for setting in sweeping.grid(sizes):
        fit(with_parameters(scorer(settings), setting), *matches.image_sizes)


def shown(value: Any) -> str:
    """A value as it is written."""
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float | np.floating) else str(value)
