"""What a sweep varies, written in plain values: words, numbers, None."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mfvpr.scoring.fields import declared
from mfvpr.scoring.parameters import fit, with_parameters
from mfvpr.scoring.scorer import Scorer
from mfvpr.tuning.sweeps.settings import FUSION, Setting, grid
from mfvpr.utils.errors import InputError

MAX_DISTANCE = "max_distance"
CAPACITY = ("bin_size", "align")  # what decides how many bins there are


@dataclass(frozen=True)
class Axes:
    """What is varied.

    Attributes:
        scorer: whose other parameters stay.
        values: by name, different ones of each. Names are fields of the scorer, their values plain where the field is
            declared (`mfvpr.scoring.fields`: a weight is the word `fs`, no limit is None); `max_distance` of matches,
            None = any; and `c` of the fusion with the filter, "auto" = balanced.
        own: the value of each that the scorer has, or would be used without a sweep; plain as well.
    """

    scorer: Scorer
    values: Mapping[str, Sequence[Any]]
    own: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Settings of the grid."""
        return math.prod(map(len, self.values.values()))

    def grid(self) -> list[dict[str, Any]]:
        """Every combination, plain."""
        return grid(self.values)

    def without(self, name: str) -> "Axes":
        """The others."""
        values, own = ({key: one for key, one in of.items() if key != name} for of in (self.values, self.own))
        return Axes(self.scorer, values, own)

    def setting(self, plain: Mapping[str, Any]) -> Setting:
        """A combination as `mfvpr.tuning.sweeps.sweep` takes it.

        Raises:
            InputError: a word that is none of its parameter's.
        """
        return {name: self._value(name, value) for name, value in plain.items()}

    def check(self, image_sizes: tuple[np.ndarray, np.ndarray]) -> None:
        """Refuse before any work what would be refused when its turn comes.

        Args:
            image_sizes: `[n, 2]` of queries and of database images, all that occur (`MatchSet.image_sizes`).

        Raises:
            InputError: the scorer's own values are of other parameters, or histograms have more bins than there may be.
        """
        if {*self.own} != {*self.values}:
            raise InputError(f"own: expected a value of each of {', '.join(self.values)}, got {', '.join(self.own)}")
        for setting in grid({name: self.values[name] for name in CAPACITY if name in self.values}):
            fit(with_parameters(self.scorer, setting), *image_sizes)

    def _value(self, name: str, value: Any) -> Any:
        if name == FUSION:
            return None if value == "auto" else float(value)
        if name == MAX_DISTANCE:
            return math.inf if value is None else value
        parameter = declared(self.scorer).get(name)
        if parameter is None:
            return value
        if parameter.named is not None and value not in parameter.named:
            raise InputError(f"{name}={value!r}: expected one of {', '.join(parameter.named)}")
        return parameter.value(value)
