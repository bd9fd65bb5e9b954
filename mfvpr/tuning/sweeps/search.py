"""Search for the best setting: all settings of a grid, or those that Optuna proposes, batch by batch."""

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from mfvpr.evaluation.protocol import EvaluationProtocol
from mfvpr.matching.match_set import MatchSet, Scales
from mfvpr.scoring.fields import parameters_of
from mfvpr.tuning.sweeps.axes import Axes
from mfvpr.tuning.sweeps.outcome import Outcome
from mfvpr.tuning.sweeps.sweep import sweep
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.progress import Track, no_progress

if TYPE_CHECKING:
    import optuna

BATCH = 16  # settings of one compiled call, after which Optuna gets their recalls
KS = (1, 5, 10)

Stages = Callable[[str], Track]  # the name of a stage -> its progress


def untracked_stages(stage: str) -> Track:
    """No progress bars."""
    return no_progress


def search_grid(
    axes: Axes, protocol: EvaluationProtocol, match_set: MatchSet | Scales, candidates: Shortlist, *,
    ks: Sequence[int] = KS, track: Stages = untracked_stages, **options: Any,
) -> Outcome:  # fmt: skip
    """Rank with every setting of a grid, and with the scorer's own values if the grid does not have them.

    Args:
        axes: of the grid.
        protocol: the ground truth, and the queries to choose on.
        match_set: matches of Q queries with C candidates.
        candidates: their shortlist.
        ks: of the recall.
        track: progress.
        options: of `mfvpr.tuning.sweeps.sweep`: `ties`, `retrieval_score`, the sizes of blocks, and their folder.

    Raises:
        InputError: a setting cannot be scored.
    """
    axes.check(match_set.image_sizes)
    protocol, own_values, settings = protocol.of(candidates), dict(axes.own), axes.grid()
    settings += [] if own_values in settings else [own_values]
    rank = _ranker(axes, protocol, match_set, candidates, depth=max(ks), **options)
    return Outcome(axes, protocol, settings, rank(settings, track("sweep")), sorted({*ks}), is_grid=True)


def search_optuna(
    axes: Axes, protocol: EvaluationProtocol, match_set: MatchSet | Scales, candidates: Shortlist, *,
    trials: int, seed: int = 0, ks: Sequence[int] = KS, track: Stages = untracked_stages, **options: Any,
) -> Outcome:  # fmt: skip
    """Rank with the scorer's own values, and with settings that Optuna's sampler (TPE) proposes from a seed.

    Numbers are drawn between the smallest and the largest value of an axis, words among its values. If the protocol has
    halves, Optuna gets the mean recall of the queries to choose on. Arguments not listed here are those of
    `search_grid`.

    Args:
        axes: bounds, or words to choose from.
        trials: number of settings that Optuna proposes.
        seed: of the sampler.

    Raises:
        InputError: Optuna is not installed, or a setting cannot be scored.
    """
    require_optuna()
    import optuna

    axes.check(match_set.image_sizes)
    protocol = protocol.of(candidates)
    rank = _ranker(axes, protocol, match_set, candidates, depth=max(ks), **options)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    settings: list[Mapping[str, Any]] = [dict(axes.own)]
    rows = [rank(settings, track("own values"))]
    for start in range(0, trials, BATCH):
        batch = [study.ask() for _ in range(min(BATCH, trials - start))]
        proposed = [suggest_setting(trial, axes) for trial in batch]
        rows.append(rank(proposed, track(f"trials {start + 1} to {start + len(batch)}")))
        recall = protocol.tuning(rows[-1])[..., protocol.main].mean(axis=0)
        for trial, value in zip(batch, recall, strict=True):
            study.tell(trial, float(value))
        settings += proposed
    return Outcome(axes, protocol, settings, np.concatenate(rows, axis=1), sorted({*ks}), is_grid=False)


def require_optuna() -> None:
    """Raise `InputError` if Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("Optuna is not installed; pip install 'mfvpr[sweep]'")


def _ranker(
    axes: Axes, protocol: EvaluationProtocol, match_set: MatchSet | Scales, candidates: Shortlist, **options: Any
) -> Callable[[Sequence[Mapping[str, Any]], Track], np.ndarray]:
    """A function of plain settings that returns the rows `[V, S, Q, depth]` of their rankings."""
    return lambda settings, track: sweep(
        axes.scorer, [axes.setting(plain) for plain in settings], match_set, candidates,
        views=protocol.views, track=track, **options,
    )  # fmt: skip


def suggest_setting(trial: "optuna.Trial", axes: Axes) -> dict[str, Any]:
    """Draw a plain value of every axis."""
    integers = {name for name, parameter in parameters_of(axes.scorer).items() if parameter.whole}
    return {name: _suggest(trial, name, values, is_integer=name in integers) for name, values in axes.values.items()}


def _suggest(trial: "optuna.Trial", name: str, values: Sequence[Any], *, is_integer: bool) -> Any:
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(numbers) < len(values) or len(values) == 1:
        return trial.suggest_categorical(name, values)
    suggest = trial.suggest_int if is_integer else trial.suggest_float
    return suggest(name, min(values), max(values))
