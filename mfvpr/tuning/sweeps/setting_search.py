"""Search for the best setting on axes of plain values: all of a grid, or what Optuna proposes; and its result."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from mfvpr.baselines.learned_weight import WORDS, named_weight
from mfvpr.baselines.scorers import SCORERS
from mfvpr.core.batch import MATCH_AXES, refuse_own_names
from mfvpr.core.scorer import (
    Scorer,
    check_bounds,
    fit_capacities,
    numbers_by_name,
    parameters_of,
    static_names,
    with_parameters,
)
from mfvpr.core.types import Shortlist
from mfvpr.core.weights import WEIGHTS
from mfvpr.evaluation.protocol import EvaluationProtocol, best_setting
from mfvpr.evaluation.statistics import Estimate, McNemar, PathTest, estimate, mcnemar, path_test
from mfvpr.matchers.match_set import MatchSet, Scales
from mfvpr.tuning.sweeps.setting_rankings import DEFAULT_OPTIONS, FUSION, Setting, SweepOptions, grid, rank_settings
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import Setting as Declared

if TYPE_CHECKING:
    import optuna

MAX_DISTANCE = "max_distance"
CAPACITY = ("bin_size", "align")  # parameters that determine the number of bins
BATCH = 16  # settings of one compiled call, after which Optuna gets their recalls


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
        own_values: by name, the plain value without a sweep. Default: the scorer's, no limit of `max_distance`, and
            c = 0.

    Raises:
        InputError: an axis without values or with equal ones, an unknown word, or a name that the scorer does not have.
    """

    scorer: Scorer
    values: Mapping[str, Sequence[Any]]
    own_values: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scorer = self.scorer
        refuse_own_names(scorer, self.values, reserved=(*MATCH_AXES, FUSION))
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
        object.__setattr__(self, "values", values)
        chosen = self.own_values
        own_values = {name: chosen[name] if name in chosen else self._own_value(name) for name in values}
        object.__setattr__(self, "own_values", own_values)
        for name, value in ((name, value) for name, axis in values.items() for value in axis):  # before any work
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

    def setting(self, plain: Mapping[str, Any]) -> Setting:
        """Convert plain values to a setting of `mfvpr.tuning.sweeps.rank_settings`."""
        converters: dict[str, Callable[[Any], Any]] = {
            **{name: parameter.value for name, parameter in self.parameters.items()},
            FUSION: lambda c: None if c == "auto" else float(c),
            MAX_DISTANCE: lambda limit: math.inf if limit is None else limit,
            "weight": named_weight,
        }
        return {name: converters[name](value) if name in converters else value for name, value in plain.items()}

    def _own_value(self, name: str) -> Any:
        if name in (MAX_DISTANCE, FUSION):
            return None if name == MAX_DISTANCE else 0
        value = attrgetter(name)(self.scorer)
        if name == "weight":
            words = [word for word, weight in WEIGHTS.items() if weight == value]
            words += [word for word in WORDS if named_weight(word) is value]
            return words[0] if words else value
        return None if name in self.parameters and value == self.parameters[name].none else _plain(value)


def can_learn(scorer: Any) -> bool:
    """Whether a scorer, or a class of scorers, has fields that are declared to be learned."""
    return any(parameter.learned for parameter in parameters_of(scorer).values())


def _plain(value: Any) -> Any:
    """The number that a scalar array holds; any other value as it is."""
    return value.item() if isinstance(value, np.generic | np.ndarray | jax.Array) else value


class Verdict(NamedTuple):
    """Comparison of the recall@1 of the chosen settings, first, with the scorer's own values, at one threshold."""

    threshold: float
    queries: int  # that are reported on
    chosen: Estimate
    own: Estimate
    mcnemar: McNemar
    path_test: PathTest


@dataclass(frozen=True)
class Outcome:
    """All rankings of a sweep, and their evaluation."""

    axes: Axes
    protocol: EvaluationProtocol  # the ground truth, with the views of the shortlist
    settings: Sequence[Mapping[str, Any]]  # in plain values; those of a complete grid come first, in its order
    rows: Int[np.ndarray, "views settings queries depth"]  # of the database, best first
    ks: Sequence[int]  # depths of the recall, ascending, up to the depth of `rows`
    is_grid: bool  # whether `settings` has all settings of the grid

    @cached_property
    def recall(self) -> Float[np.ndarray, "settings tolerances"]:
        """Recall@1 over all queries."""
        return self.protocol.recall(self.rows[0])

    @property
    def own(self) -> int:
        """Number of the setting with the scorer's own values."""
        return self.settings.index(dict(self.axes.own_values))

    @cached_property
    def _tuning(self) -> Float[np.ndarray, "halves settings"]:
        """Recall@1 on the queries to choose on; below 0 for the scorer's own values where they are no choice."""
        recall = self.protocol.tuning(self.rows)[..., self.protocol.main]
        if self.is_grid:
            return recall[:, : self.axes.size]
        return np.where(np.arange(len(self.settings)) == self.own, -1.0, recall)

    @cached_property
    def chosen(self) -> list[int]:
        """Number of the best setting, for each half."""
        return [best_setting(recall, self.axes.values if self.is_grid else None) for recall in self._tuning]

    @cached_property
    def best(self) -> int:
        """Number of the best setting by the mean recall of the halves."""
        return best_setting(self._tuning.mean(axis=0), self.axes.values if self.is_grid else None)

    @cached_property
    def report(self) -> list[Verdict]:
        """Verdicts by threshold, on the queries to report on."""
        chosen_hits = self.protocol.reported_hits(self.rows, self.chosen)
        own_hits = self.protocol.reported_hits(self.rows, [self.own] * len(self.chosen))
        verdicts = []
        for threshold, first, second in zip(self.protocol.thresholds, chosen_hits, own_hits, strict=True):
            tests = mcnemar(first, second), path_test(first, second)
            verdicts.append(Verdict(threshold, len(first), estimate(first), estimate(second), *tests))
        return verdicts


def search_grid(
    axes: Axes,
    protocol: EvaluationProtocol,
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    options: SweepOptions = DEFAULT_OPTIONS,
) -> Outcome:
    """Rank with every setting of a grid, and with the scorer's own values if the grid does not have them."""
    protocol, settings = protocol.of(candidates), axes.grid()
    settings += [] if dict(axes.own_values) in settings else [dict(axes.own_values)]
    of_scorer = list(map(axes.setting, settings))
    rows = rank_settings(axes.scorer, of_scorer, match_set, candidates, views=protocol.views, options=options)
    return Outcome(axes, protocol, settings, rows, sorted({*options.ks}), is_grid=True)


def search_optuna(
    axes: Axes,
    protocol: EvaluationProtocol,
    match_set: MatchSet | Scales,
    candidates: Shortlist,
    options: SweepOptions = DEFAULT_OPTIONS,
    *,
    trials: int,
    seed: int = 0,
) -> Outcome:
    """Rank with the scorer's own values, and with settings that Optuna's sampler (TPE) proposes from a seed.

    Numbers are drawn between the smallest and the largest value of an axis, words among its values. If the protocol has
    halves, Optuna gets the mean recall of the queries to choose on.
    """
    require_optuna()
    import optuna

    for setting in grid({name: axes.values[name] for name in CAPACITY if name in axes.values}):  # before any work
        fit_capacities(with_parameters(axes.scorer, setting), *match_set.image_sizes)
    protocol, settings = protocol.of(candidates), [dict(axes.own_values)]

    def rank(settings: list[dict[str, Any]], label: str) -> np.ndarray:
        of_scorer, labeled = list(map(axes.setting, settings)), replace(options, label=label)
        return rank_settings(axes.scorer, of_scorer, match_set, candidates, views=protocol.views, options=labeled)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    rows = [rank(settings, "own values")]
    while (done := len(settings) - 1) < trials:
        batch = [study.ask() for _ in range(min(BATCH, trials - done))]
        proposed = [suggest_setting(trial, axes) for trial in batch]
        rows.append(rank(proposed, f"trials {done + 1} to {done + len(batch)} of {trials}"))
        recall = protocol.tuning(rows[-1])[..., protocol.main].mean(axis=0)
        for trial, value in zip(batch, recall, strict=True):
            study.tell(trial, float(value))
        settings += proposed
    return Outcome(axes, protocol, settings, np.concatenate(rows, axis=1), sorted({*options.ks}), is_grid=False)


def require_optuna() -> None:
    """Raise `InputError` if Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("Optuna is not installed; pip install 'mfvpr[sweep]'")


def suggest_setting(trial: "optuna.Trial", axes: Axes) -> dict[str, Any]:
    """Draw a plain value of every axis."""
    setting = {}
    for name, values in axes.values.items():
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        if len(numbers) < len(values) or len(values) == 1:
            setting[name] = trial.suggest_categorical(name, values)
        elif name in axes.parameters and axes.parameters[name].rule.is_whole:
            setting[name] = trial.suggest_int(name, min(values), max(values))
        else:
            setting[name] = trial.suggest_float(name, min(values), max(values))
    return setting
