"""Search of spaces too large for a grid: Optuna proposes settings, batch by batch; the compiled sweep judges them."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.axes import Axes
from experiments.settings import SettingsError
from mfvpr.evaluation import Judge

if TYPE_CHECKING:
    import optuna

BATCH = 16  # settings of one compiled call; Optuna learns of them together


def require() -> None:
    """Refuse before anything slow."""
    if find_spec("optuna") is None:
        raise SettingsError("search=optuna: Optuna is not installed; pip install 'mfvpr[sweep]', or search=grid")


def search(
    settings: dict[str, Any], axes: Axes, judge: Judge, rows_of: Callable[[list[dict[str, Any]], str], np.ndarray]
) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Settings as written, the scorer's own values first, and the rows `[V, S, Q, depth]` of their rankings.

    Numbers are drawn between the smallest and the largest of an axis, words among them. With `split=` each setting is
    judged by the mean of what the halves that choose may see.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=settings["seed"]))
    written = [dict(axes.own)]
    rows = [rows_of(written, "own values")]
    for start in range(0, settings["trials"], BATCH):
        trials = [study.ask() for _ in range(min(BATCH, settings["trials"] - start))]
        asked = [{name: _suggested(trial, axes, name, axis) for name, axis in axes.values.items()} for trial in trials]
        found = rows_of(asked, f"trials {start + 1} to {start + len(trials)}")
        recall = judge.tuning(found)[..., judge.main].mean(axis=0)
        for trial, value in zip(trials, recall, strict=True):
            study.tell(trial, float(value))
        written += asked
        rows.append(found)
    return written, np.concatenate(rows, axis=1)


def _suggested(trial: "optuna.Trial", axes: Axes, name: str, axis: Any) -> Any:
    numbers = [value for value in axis if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(numbers) < len(axis) or len(axis) == 1:
        return trial.suggest_categorical(name, axis)
    if name in axes.parameters and axes.parameters[name].whole:
        return trial.suggest_int(name, min(axis), max(axis))
    return trial.suggest_float(name, min(axis), max(axis))
