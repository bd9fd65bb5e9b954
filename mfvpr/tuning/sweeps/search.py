"""The search for the best setting: all of a grid, or of a larger space those that Optuna proposes, batch by batch."""

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from mfvpr.evaluation.protocol import Judge
from mfvpr.matching.match_set import MatchSet, Scales
from mfvpr.scoring.fields import declared
from mfvpr.tuning.sweeps.axes import Axes
from mfvpr.tuning.sweeps.outcome import Outcome
from mfvpr.tuning.sweeps.sweep import sweep
from mfvpr.types import Shortlist
from mfvpr.utils.errors import InputError
from mfvpr.utils.progress import Track, untracked

if TYPE_CHECKING:
    import optuna

BATCH = 16  # settings of one compiled call; Optuna learns of them together
KS = (1, 5, 10)

Stages = Callable[[str], Track]  # the name of a stage -> its progress


def untracked_stages(stage: str) -> Track:
    """No progress bars."""
    return untracked


def search_grid(
    axes: Axes, judge: Judge, match_set: MatchSet | Scales, candidates: Shortlist, *,
    ks: Sequence[int] = KS, track: Stages = untracked_stages, **options: Any,
) -> Outcome:  # fmt: skip
    """Every setting of the grid, and the scorer's own values last where the grid does not have them.

    Args:
        axes: of the grid.
        judge: what is right, and which queries choose.
        match_set: matches of Q queries with C candidates.
        candidates: their shortlist.
        ks: of the recall.
        track: progress.
        options: of `mfvpr.tuning.sweeps.sweep`: `ties`, `filter_score`, the sizes of blocks, and their folder.

    Raises:
        InputError: a setting cannot be scored.
    """
    axes.check(match_set.image_sizes)
    judge, own, settings = judge.of(candidates), dict(axes.own), axes.grid()
    settings += [] if own in settings else [own]
    ranked = _ranker(axes, judge, match_set, candidates, depth=max(ks), **options)
    return Outcome(axes, judge, settings, ranked(settings, track("sweep")), sorted({*ks}), is_grid=True)


def search_optuna(
    axes: Axes, judge: Judge, match_set: MatchSet | Scales, candidates: Shortlist, *,
    trials: int, seed: int = 0, ks: Sequence[int] = KS, track: Stages = untracked_stages, **options: Any,
) -> Outcome:  # fmt: skip
    """The scorer's own values, and the settings that Optuna's sampler (TPE) proposes, which depend on the seed alone.

    Numbers are drawn between the smallest and the largest of an axis, words among them. Where the judge has halves each
    setting is judged by the mean of what those that choose may see.

    Args:
        axes: bounds, or words to choose from.
        judge: see `search_grid`, as of the other arguments.
        match_set: see there.
        candidates: see there.
        trials: how many settings are proposed.
        seed: of the sampler.
        ks: see there.
        track: see there.
        options: see there.

    Raises:
        InputError: Optuna is not installed, or a setting cannot be scored.
    """
    require_optuna()
    import optuna

    axes.check(match_set.image_sizes)
    judge = judge.of(candidates)
    ranked = _ranker(axes, judge, match_set, candidates, depth=max(ks), **options)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    settings: list[Mapping[str, Any]] = [dict(axes.own)]
    rows = [ranked(settings, track("own values"))]
    for start in range(0, trials, BATCH):
        asked = [study.ask() for _ in range(min(BATCH, trials - start))]
        proposed = [suggest_setting(trial, axes) for trial in asked]
        rows.append(ranked(proposed, track(f"trials {start + 1} to {start + len(asked)}")))
        recall = judge.tuning(rows[-1])[..., judge.main].mean(axis=0)
        for trial, value in zip(asked, recall, strict=True):
            study.tell(trial, float(value))
        settings += proposed
    return Outcome(axes, judge, settings, np.concatenate(rows, axis=1), sorted({*ks}), is_grid=False)


def require_optuna() -> None:
    """Refuse before anything slow.

    Raises:
        InputError: Optuna is not installed.
    """
    if find_spec("optuna") is None:
        raise InputError("Optuna is not installed; pip install 'mfvpr[sweep]'")


def _ranker(
    axes: Axes, judge: Judge, match_set: MatchSet | Scales, candidates: Shortlist, **options: Any
) -> Callable[[Sequence[Mapping[str, Any]], Track], np.ndarray]:
    """Plain settings -> rows `[V, S, Q, depth]` of their rankings."""
    return lambda settings, track: sweep(
        axes.scorer, [axes.setting(one) for one in settings], match_set, candidates,
        views=judge.views, track=track, **options,
    )  # fmt: skip


def suggest_setting(trial: "optuna.Trial", axes: Axes) -> dict[str, Any]:
    whole = {name for name, parameter in declared(axes.scorer).items() if parameter.whole}
    return {name: _drawn(trial, name, values, whole=name in whole) for name, values in axes.values.items()}


def _drawn(trial: "optuna.Trial", name: str, values: Sequence[Any], *, whole: bool) -> Any:
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(numbers) < len(values) or len(values) == 1:
        return trial.suggest_categorical(name, values)
    draw = trial.suggest_int if whole else trial.suggest_float
    return draw(name, min(values), max(values))
