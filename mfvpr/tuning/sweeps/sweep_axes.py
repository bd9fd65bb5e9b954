"""The axes of a sweep, in plain values: words, numbers, None."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from operator import attrgetter
from typing import Any

import jax
import numpy as np

from mfvpr.baselines.scorers import SCORERS
from mfvpr.baselines.weight_registry import NAMED_WEIGHTS, named_weight
from mfvpr.core.batch import WEIGHTINGS, refuse_own_names
from mfvpr.core.scorer import (
    Scorer,
    check_bounds,
    fit_capacities,
    numbers_by_name,
    parameters_of,
    static_names,
    with_parameters,
)
from mfvpr.core.weights import WEIGHTS
from mfvpr.tuning.sweeps.setting_groups import FUSION, Setting, grid
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import Setting as Declared

MAX_DISTANCE = "max_distance"
CAPACITY = ("bin_size", "align")  # parameters that determine the number of bins


@dataclass(frozen=True)
class Axes:
    """Parameters to vary, and their values.

        axes = Axes(mfvpr.HistogramOfShifts(), {"sigma": [5, 10, 22.5], "weight": ["fs", "ratio"]})

    Attributes:
        scorer: its other parameters stay.
        values: distinct values by name. A name is a field of the scorer, `max_distance` of matches (None = any), or `c`
            of the fusion with retrieval ("auto" = balanced). Values of declared fields are plain
            (`mfvpr.core.scorer`: a weight is the word `fs`, no limit is None). Words stand for weights in every
            scorer.
        own: by name, the plain value without a sweep. Default: the scorer's, no limit of `max_distance`, and c = 0.

    Raises:
        InputError: an axis without values or with equal ones, an unknown word, or a name that the scorer does not have.
    """

    scorer: Scorer
    values: Mapping[str, Sequence[Any]]
    own: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scorer = self.scorer
        refuse_own_names(scorer, self.values, reserved=(*WEIGHTINGS, FUSION))
        known = sorted({*numbers_by_name(scorer), *static_names(scorer), *self.parameters})
        known += ["weight"] if hasattr(scorer, "weight") and "weight" not in known else []
        values = {}
        for name, axis in self.values.items():
            if name not in {*known, MAX_DISTANCE, FUSION}:
                names = ", ".join([*known, MAX_DISTANCE, FUSION])
                raise InputError(f"{name}: expected a parameter of {type(scorer).__name__}, of {names}")
            is_list = np.iterable(axis) and not isinstance(axis, str)
            values[name] = list(map(_plain, axis)) if is_list else []
            if len({*values[name]}) < max(1, len(values[name])):
                raise InputError(f"{name}={axis!r}: expected different values, in a list")
        own = {name: self.own[name] if name in self.own else self._own(name) for name in values}
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "own", own)
        for name, axis in values.items():  # before any work
            for value in axis:
                setting = self.setting({name: value})
                if name in self.parameters and type(scorer) in SCORERS.values():
                    check_bounds(with_parameters(scorer, setting))

    @property
    def parameters(self) -> Mapping[str, Declared]:
        """Declared parameters of the scorer."""
        return parameters_of(self.scorer) if is_dataclass(self.scorer) else {}

    @property
    def size(self) -> int:
        """Number of settings of the grid."""
        return math.prod(map(len, self.values.values()))

    def grid(self) -> list[dict[str, Any]]:
        """Every combination of the plain values."""
        return grid(self.values)

    def without(self, name: str) -> "Axes":
        """All axes but one."""
        return Axes(self.scorer, {key: value for key, value in self.values.items() if key != name}, self.own)

    def setting(self, plain: Mapping[str, Any]) -> Setting:
        """Convert plain values to a setting of `mfvpr.tuning.sweeps.rank_settings`."""
        special: dict[str, Callable[[Any], Any]] = {
            FUSION: lambda c: None if c == "auto" else float(c),
            MAX_DISTANCE: lambda limit: math.inf if limit is None else limit,
            "weight": named_weight,
        }
        declared = {name: parameter.value for name, parameter in self.parameters.items()}
        converters = declared | special
        return {name: converters[name](value) if name in converters else value for name, value in plain.items()}

    def check(self, image_sizes: tuple[np.ndarray, np.ndarray]) -> None:
        """Raise an InputError before any work if a histogram of these `MatchSet.image_sizes` has too many bins."""
        for setting in grid({name: self.values[name] for name in CAPACITY if name in self.values}):
            fit_capacities(with_parameters(self.scorer, setting), *image_sizes)

    def _own(self, name: str) -> Any:
        """The plain value without a sweep."""
        if name in (MAX_DISTANCE, FUSION):
            return None if name == MAX_DISTANCE else 0
        value = attrgetter(name)(self.scorer)
        if name == "weight":
            words = [word for word, weight in WEIGHTS.items() if weight == value]
            words += [word for word, weight in NAMED_WEIGHTS.items() if weight is value]
            return words[0] if words else value
        is_none = name in self.parameters and value == self.parameters[name].none
        return None if is_none else _plain(value)


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of scorers, has fields that are declared to be learned."""
    return any(parameter.learned for parameter in parameters_of(scorer).values())


def _plain(value: Any) -> Any:
    """The number that a scalar array holds; any other value as it is."""
    return value.item() if isinstance(value, np.generic | np.ndarray | jax.Array) else value
