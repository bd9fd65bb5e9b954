"""The axes of a sweep, in plain values: words, numbers, None."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mfvpr.scoring.fields import parameters_of
from mfvpr.scoring.parameters import with_capacity, with_parameters
from mfvpr.scoring.scorer import Scorer
from mfvpr.tuning.sweeps.settings import FUSION, Setting, grid
from mfvpr.utils.errors import InputError

MAX_DISTANCE = "max_distance"
CAPACITY = ("bin_size", "align")  # parameters that determine the number of bins


@dataclass(frozen=True)
class Axes:
    """Parameters to vary, and their values.

    Attributes:
        scorer: its other parameters stay.
        values: distinct values by name. A name is a field of the scorer, `max_distance` of matches (None = any), or `c`
            of the fusion with retrieval ("auto" = balanced). Values of declared fields are plain
            (`mfvpr.scoring.fields`: a weight is the word `fs`, no limit is None).
        own: by name, the plain value of the scorer, or the one that is used without a sweep.
    """

    scorer: Scorer
    values: Mapping[str, Sequence[Any]]
    own: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Number of settings of the grid."""
        return math.prod(map(len, self.values.values()))

    def grid(self) -> list[dict[str, Any]]:
        """Every combination of the plain values."""
        return grid(self.values)

    def without(self, name: str) -> "Axes":
        """All axes but one."""
        values = {key: value for key, value in self.values.items() if key != name}
        return Axes(self.scorer, values, {key: value for key, value in self.own.items() if key != name})

    def setting(self, plain: Mapping[str, Any]) -> Setting:
        """Convert plain values to a setting of `mfvpr.tuning.sweeps.sweep`.

        Raises:
            InputError: a word that its parameter does not have.
        """
        return {name: self._value(name, value) for name, value in plain.items()}

    def check(self, image_sizes: tuple[np.ndarray, np.ndarray]) -> None:
        """Raise errors of settings before any work.

        Args:
            image_sizes: `[n, 2]` all sizes of queries and of database images (`MatchSet.image_sizes`).

        Raises:
            InputError: `own` and `values` have different names, or a histogram has too many bins.
        """
        if {*self.own} != {*self.values}:
            raise InputError(f"own: expected a value of each of {', '.join(self.values)}, got {', '.join(self.own)}")
        for setting in grid({name: self.values[name] for name in CAPACITY if name in self.values}):
            with_capacity(with_parameters(self.scorer, setting), *image_sizes)

    def _value(self, name: str, value: Any) -> Any:
        if name == FUSION:
            return None if value == "auto" else float(value)
        if name == MAX_DISTANCE:
            return math.inf if value is None else value
        parameter = parameters_of(self.scorer).get(name)
        if parameter is None:
            return value
        if parameter.named is not None and value not in parameter.named:
            raise InputError(f"{name}={value!r}: expected one of {', '.join(parameter.named)}")
        return parameter.value(value)
