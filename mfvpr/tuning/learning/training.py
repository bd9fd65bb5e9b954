"""Gradient descent on a pytree of arrays, with validation, early stopping, and resuming to the bit."""

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mfvpr.core.types import Array
from mfvpr.storage.cache_files import Arrays, CacheFiles
from mfvpr.utils.errors import InputError
from mfvpr.utils.runtime import Track, no_progress

_KEY = "00state"  # of the file in the folder of a training


class TrainingError(InputError):
    """A value became NaN or infinite. The message is one line: the step, the value, and how to fix it."""


class Record(NamedTuple):
    """One validation."""

    step: int  # number of steps before it
    loss: float | None  # mean over the steps since the previous record; None before the first step
    validation: float  # its result, smaller = better


class Fit(NamedTuple):
    """The result of a training."""

    parameters: Any  # of the best validation, which may be the start
    step: int  # number of steps that lead to them
    history: tuple[Record, ...]  # every validation, the start first
    ended: str  # why the training ended, in words


class Checkpoints(NamedTuple):
    """Where the last state of each training is kept, from which it resumes, to the bit with the same `every`."""

    folder: Path
    recipe: Mapping[str, Any]  # JSON values that determine the result: the model, the data, all settings
    name: str = "training"  # of the checkpoint's folder, before the hash of the recipe


@dataclass(frozen=True)
class Schedule:
    """The schedule of a training."""

    optimizer: optax.GradientTransformation
    steps: int  # total number of updates, also of a resumed training
    every: int = 10  # steps from one validation, and checkpoint, to the next; the last step has both as well
    patience: int | None = None  # validations without a gain after which to stop; None = do all steps


@dataclass(frozen=True)
class State:
    """All that a training knows: what a checkpoint holds."""

    parameters: Any
    best: Any  # parameters of the best validation
    optimizer: Any  # state of the optimizer
    history: tuple[Record, ...] = ()
    losses: tuple[float, ...] = ()  # of the steps since the last record

    @property
    def step(self) -> int:
        """Number of steps that are done."""
        return (self.history[-1].step if self.history else 0) + len(self.losses)

    @property
    def best_record(self) -> Record:
        """The first record with the smallest validation."""
        return min(self.history, key=lambda record: record.validation)

    def is_out_of(self, patience: int | None) -> bool:
        """Whether so many validations had no gain."""
        return patience is not None and len(self.history) - 1 - self.history.index(self.best_record) >= patience


def fit(
    parameters: Any,
    objective: Callable[[Any, Any], Array],
    batches: Callable[[int], Any],
    schedule: Schedule,
    *,
    validate: Callable[[Any], float],
    checkpoints: Checkpoints | None = None,
    track: Track = no_progress,
) -> Fit:
    """Minimize the objective.

    Args:
        parameters: pytree of floating-point arrays to start from.
        objective: parameters and a batch -> loss `[]`; compiled once per shape of the batches.
        batches: a step, counted from 0, -> its batch; the same batch in every call.
        validate: parameters -> a number, smaller = better.

    Raises:
        InputError: the folder cannot be used, or has a checkpoint of more steps of this training.
        TrainingError: loss, gradient, parameters or validation are not finite. The last checkpoint stays.
    """
    every, steps, patience = schedule.every, schedule.steps, schedule.patience

    @jax.jit
    def update(parameters: Any, memory: Any, batch: Any) -> tuple[Any, Any, Array, Array]:
        loss, gradient = jax.value_and_grad(objective)(parameters, batch)
        with jax.numpy_dtype_promotion("standard"):  # Optax's Adam multiplies a float with an integer
            change, memory = schedule.optimizer.update(gradient, memory, parameters)
        parameters = optax.apply_updates(parameters, change)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, gradient, parameters))]
        return parameters, _strong(memory), loss, jnp.all(jnp.stack(finite))

    def add_record(state: State) -> State:
        loss = float(np.mean(state.losses)) if state.losses else None
        value = float(validate(state.parameters))
        if not math.isfinite(value):
            raise _not_finite("the validation", state.step)
        added = replace(state, history=(*state.history, Record(state.step, loss, value)), losses=())
        return replace(added, best=state.parameters) if added.best_record is added.history[-1] else added

    parameters = _strong(parameters)
    state = State(parameters, parameters, _strong(schedule.optimizer.init(parameters)))
    files = checkpoints and _files(checkpoints, state)
    stored = files and files.get(_KEY)
    if files and not stored and _KEY in files:
        warnings.warn(f"{files.path(_KEY)}: the checkpoint is damaged; the training starts again", stacklevel=2)
    state = stored or add_record(state)
    if files and state.step > steps:
        got = f"the checkpoint in {files.folder} is of step {state.step}"
        raise InputError(f"steps={steps}: {got}; ask for more steps, or choose another folder")
    remaining = 0 if state.is_out_of(patience) else steps - state.step
    for step in track(range(state.step, state.step + remaining), remaining):
        learned, memory, loss, is_finite = update(state.parameters, state.optimizer, batches(step))
        if not is_finite:
            raise _not_finite(f"the loss, a gradient or a parameter of batch {step}", step)
        state = replace(state, parameters=learned, optimizer=memory, losses=(*state.losses, float(loss)))
        if is_due := state.step % every == 0:
            state = add_record(state)
        if files and (is_due or state.step == steps):
            files.update({_KEY: state})
        if state.is_out_of(patience):
            break
    if state.losses:  # after the checkpoint: a training of more steps would not validate here
        state = add_record(state)
    ended = f"no gain in {patience} validations" if state.is_out_of(patience) else f"all {steps} steps are done"
    return Fit(state.best, state.best_record.step, state.history, ended)


def _not_finite(what: str, step: int) -> TrainingError:
    return TrainingError(f"step {step}: {what} is not finite; look at the data, or lower the learning rate")


def _strong(tree: Any) -> Any:
    """Arrays with strong types: a weak type would compile once more when a strong one takes its place."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(leaf)), tree)


def _files(checkpoints: Checkpoints, start: State) -> CacheFiles[State]:
    """The folder of a training's last state, whose trees are those of the start."""

    def pack(state: State) -> Arrays:
        arrays = {str(place): leaf for place, leaf in enumerate(jax.tree.leaves(_trees(state)))}
        record = json.dumps([state.history, state.losses]).encode()
        return arrays | {"record": np.frombuffer(record, np.uint8)}

    def unpack(arrays: Arrays) -> State:
        history, losses = json.loads(arrays["record"].tobytes())
        leaves = [arrays[str(place)] for place in range(len(arrays) - 1)]
        parameters, best, optimizer = _strong(jax.tree.unflatten(jax.tree.structure(_trees(start)), leaves))
        return State(parameters, best, optimizer, tuple(Record(*row) for row in history), tuple(losses))

    return CacheFiles(checkpoints.folder, checkpoints.name, checkpoints.recipe, pack, unpack)


def _trees(state: State) -> tuple[Any, Any, Any]:
    return state.parameters, state.best, state.optimizer
