"""Gradient descent on a pytree of arrays, with validation, early stopping, and resuming to the bit."""

import json
import logging
import math
import shutil
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp

from mfvpr.core.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.runtime import Track, no_progress


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
    def arrays(self) -> tuple[Any, Any, Any]:
        """The pytrees of arrays."""
        return self.parameters, self.best, self.optimizer

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
    folder = checkpoints and checkpoints.folder / f"{checkpoints.name}-{fingerprint(checkpoints.recipe)}"
    state = (folder and restore(folder, jax.tree.structure(state.arrays))) or add_record(state)
    if state.step > steps:
        got = f"the checkpoint in {folder} is of step {state.step}"
        raise InputError(f"steps={steps}: {got}; ask for more steps, or choose another folder")
    remaining = 0 if state.is_out_of(patience) else steps - state.step
    for step in track(range(state.step, state.step + remaining), remaining):
        learned, memory, loss, is_finite = update(state.parameters, state.optimizer, batches(step))
        if not is_finite:
            raise _not_finite(f"the loss, a gradient or a parameter of batch {step}", step)
        state = replace(state, parameters=learned, optimizer=memory, losses=(*state.losses, float(loss)))
        if is_due := state.step % every == 0:
            state = add_record(state)
        if folder and (is_due or state.step == steps):
            save_checkpoint(folder, state)
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


def save_checkpoint(folder: Path, state: State) -> None:
    """Write a state, and remove the one before it."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state.arrays)]
    record = json.dumps([state.history, state.losses, _checksum(leaves)]).encode()
    arrays = {str(place): leaf for place, leaf in enumerate(leaves)} | {"record": np.frombuffer(record, np.uint8)}
    try:
        with _manager(folder) as manager:
            manager.save(state.step, args=ocp.args.StandardSave(arrays))
    except (OSError, ValueError, RuntimeError) as error:  # TensorStore's, such as of a full disk
        words = f"the checkpoint of step {state.step} cannot be written ({_reason(error)}); check the path and its disk"
        raise InputError(f"{folder}: {words}") from None


def restore(folder: Path, structure: Any) -> State | None:
    """The last state, whose arrays have this structure; None without one. A damaged one is removed, with a warning."""
    if not folder.exists():
        return None
    try:
        with _manager(folder) as manager:
            if (step := manager.latest_step()) is None:
                return None
            arrays = dict(manager.restore(step, args=ocp.args.StandardRestore()))
        history, losses, checksum = json.loads(arrays.pop("record").tobytes())
        leaves = [arrays[str(place)] for place in range(len(arrays))]
        if _checksum(leaves) != checksum:
            raise ValueError("another checksum")
        parameters, best, optimizer = _strong(jax.tree.unflatten(structure, leaves))
    except PermissionError as error:
        raise InputError(f"{folder}: the checkpoint cannot be read ({_reason(error)}); check its permissions") from None
    except Exception as error:  # of any kind from Orbax and TensorStore
        warnings.warn(
            f"{folder}: the checkpoint is damaged ({_reason(error)}); the training starts again", stacklevel=3
        )
        shutil.rmtree(folder)
        return None
    return State(parameters, best, optimizer, tuple(Record(*row) for row in history), tuple(losses))


@contextmanager
def _manager(folder: Path) -> Iterator[ocp.CheckpointManager]:
    """Orbax's manager, without its logs and warnings."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    options = ocp.CheckpointManagerOptions(
        max_to_keep=1,
        enable_async_checkpointing=False,  # `save` returns when the checkpoint is on disk
        cleanup_tmp_directories=True,  # of killed processes
        save_root_metadata=False,
    )
    try:
        manager = ocp.CheckpointManager(folder.absolute(), options=options)
        with warnings.catch_warnings(action="ignore"), manager:
            yield manager
    finally:
        logger.setLevel(level)


def _reason(error: Exception) -> str:
    return " ".join(str(error).partition("[")[0].split())[:200]


def _checksum(leaves: list[np.ndarray]) -> int:
    return zlib.crc32(b"".join(leaf.tobytes() for leaf in leaves))
