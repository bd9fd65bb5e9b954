"""Gradient descent on a pytree of arrays, with validation, early stopping, and resuming to the bit."""

import json
import logging
import math
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import orbax.checkpoint as ocp

from mfvpr.core.types import Array
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import lock_folder
from mfvpr.utils.runtime import Track, no_progress


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Lock a folder of checkpoints, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: no checkpoint can be kept here ({_reason(error)}); check the path") from None
    in_use = InputError(f"{folder}: another process trains here; wait until it ends, or choose another folder")
    with lock_folder(folder, in_use):
        yield


def save_checkpoint(folder: Path, step: int, recipe: Mapping[str, Any], state: Any, progress: Any) -> None:
    """Write the pytree `state`, with JSON values, at a step above all earlier ones; remove all but the last two."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    record = json.dumps([recipe, progress, _checksum(leaves, progress)]).encode()
    arrays = {str(place): leaf for place, leaf in enumerate(leaves)} | {"record": np.frombuffer(record, np.uint8)}
    try:
        with _manager(folder) as manager:
            manager.save(step, args=ocp.args.StandardSave(arrays))
    except (OSError, ValueError, RuntimeError) as error:
        words = f"the checkpoint of step {step} cannot be written ({_reason(error)}); check the path and its disk"
        raise InputError(f"{folder}: {words}") from None


def restore(folder: Path, recipe: Mapping[str, Any], state: Any) -> tuple[Any, Any] | None:
    """State and progress of the newest checkpoint, None without one; `state` has the same structure.

    An InputError for another recipe or damage; nothing in the folder is changed.
    """
    if not folder.exists():
        return None
    with _manager(folder, read_only=True) as manager:
        step = manager.latest_step()
        if step is None:
            return None
        try:
            arrays = dict(manager.restore(step, args=ocp.args.StandardRestore()))
            stored, progress, checksum = json.loads(arrays.pop("record").tobytes())
            leaves = [arrays[str(place)] for place in range(len(arrays))]
            if _checksum(leaves, progress) != checksum:
                raise ValueError("another checksum")
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            words = f"expected a checkpoint of mfvpr, got another or a damaged one ({_reason(error)})"
            raise InputError(f"{folder / str(step)}: {words}; delete it to go on from the one before") from None
    expected = json.loads(json.dumps(recipe))  # tuples become lists
    if names := [name for name in {**expected, **stored} if expected.get(name) != stored.get(name)]:
        words = f"expected checkpoints of this training, got those of another {names[0]}"
        raise InputError(f"{folder}: {words}; choose another folder, or delete this one")
    return jax.tree.unflatten(jax.tree.structure(state), leaves), progress


@contextmanager
def _manager(folder: Path, read_only: bool = False) -> Iterator[ocp.CheckpointManager]:
    """Orbax's manager, without its logs and warnings."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=None if read_only else 2,
            enable_async_checkpointing=False,  # `save` returns when the checkpoint is on disk
            cleanup_tmp_directories=not read_only,
            save_root_metadata=False,
            read_only=read_only,
        )
        with warnings.catch_warnings(action="ignore"), ocp.CheckpointManager(folder.absolute(), options=options) as it:
            yield it
    finally:
        logger.setLevel(level)


def _checksum(leaves: Sequence[np.ndarray], progress: Any) -> int:
    return zlib.crc32(b"".join([json.dumps(progress).encode(), *(leaf.tobytes() for leaf in leaves)]))


def _reason(error: Exception) -> str:
    return " ".join(str(error).partition("[")[0].split())[:200]


class TrainingError(InputError):
    """A value became NaN or infinite. The message is one line: the step, the value, and how to fix it."""


class Record(NamedTuple):
    """One validation."""

    step: int  # number of steps before it
    loss: float | None  # mean over the steps since the previous record; None before the first step
    validation: float | None  # its result, smaller = better; None without `validate`


class Fit(NamedTuple):
    """The result of a training."""

    parameters: Any  # of the best validation, which may be the start; the last ones without validation
    step: int  # number of steps that lead to them
    history: tuple[Record, ...]  # every validation, the start first
    ended: str  # why the training ended, in words


class _State(NamedTuple):
    parameters: Any
    best: Any
    optimizer: Any


class Checkpoints(NamedTuple):
    """A folder in which a training is resumed, to the bit with the same `every`, or a folder of such folders."""

    folder: Path
    recipe: Mapping[str, Any]  # JSON values that determine the result: the model, the data, all settings


@dataclass(frozen=True)
class Schedule:
    """The schedule of a training."""

    optimizer: optax.GradientTransformation
    steps: int  # total number of updates, also of a resumed training
    every: int = 10  # steps from one validation, and checkpoint, to the next; the last step has both as well
    patience: int | None = None  # validations without a gain after which to stop; None = do all steps


def fit(
    parameters: Any,
    objective: Callable[[Any, Any], Array],
    batches: Callable[[int], Any],
    schedule: Schedule,
    *,
    validate: Callable[[Any], float] | None = None,
    checkpoints: Checkpoints | None = None,
    track: Track = no_progress,
) -> Fit:
    """Minimize the objective.

    Args:
        parameters: pytree of floating-point arrays to start from.
        objective: parameters and a batch -> loss `[]`; compiled once per shape of the batches.
        batches: a step, counted from 0, -> its batch; the same batch in every call.
        validate: parameters -> a number, smaller = better.
        track: progress over the steps.

    Raises:
        InputError: the folder cannot be used, another process trains in it, or it has other files, or a checkpoint of
            another training or of more steps.
        TrainingError: loss, gradient, parameters or validation are not finite. The last checkpoint stays.
    """
    every, steps, patience = schedule.every, schedule.steps, schedule.patience
    if every < 1 or steps < 0 or (patience is not None and (validate is None or patience < 1)):
        raise ValueError(f"fit({steps=}, {every=}, {patience=}): expected counts, and a patience only with validate")

    @jax.jit
    def update(parameters: Any, memory: Any, batch: Any) -> tuple[Any, Any, Array, Array]:
        loss, gradient = jax.value_and_grad(objective)(parameters, batch)
        with jax.numpy_dtype_promotion("standard"):  # Optax's Adam multiplies a float with an integer
            change, memory = schedule.optimizer.update(gradient, memory, parameters)
        parameters = optax.apply_updates(parameters, change)
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, gradient, parameters))]
        return parameters, _strong(memory), loss, jnp.all(jnp.stack(finite))

    def add_record(state: _State, history: list[Record], losses: list[float]) -> tuple[_State, list[Record]]:
        """Validate; return the state with the best parameters so far, and the history."""
        step, loss = (history[-1].step + len(losses), float(np.mean(losses))) if history else (0, None)
        value = None if validate is None else float(validate(state.parameters))
        if value is not None and not math.isfinite(value):
            raise _not_finite("the validation", step)
        history = [*history, Record(step, loss, value)]
        return state._replace(best=state.parameters) if _best(history) is history[-1] else state, history

    parameters = _strong(parameters)
    state = _State(parameters, parameters, _strong(schedule.optimizer.init(parameters)))
    with _lock(checkpoints.folder) if checkpoints else nullcontext():
        stored = restore(*checkpoints, state) if checkpoints else None
        if stored:
            state, (rows, losses) = _strong(stored[0]), stored[1]
            history = [Record(*row) for row in rows]
        else:
            (state, history), losses = add_record(state, [], []), []
        done = history[-1].step + len(losses)
        if checkpoints and done > steps:
            fix = "ask for more steps, or choose another folder"
            raise InputError(
                f"{checkpoints.folder}: this checkpoint is of step {done}, expected at most {steps}; {fix}"
            )
        remaining = 0 if _out_of_patience(history, patience) else steps - done
        for step in track(range(done, done + remaining), remaining):
            learned, memory, loss, is_finite = update(state.parameters, state.optimizer, batches(step))
            if not is_finite:
                raise _not_finite(f"the loss, a gradient or a parameter of batch {step}", step)
            state, losses = _State(learned, state.best, memory), [*losses, float(loss)]
            if is_due := (step + 1) % every == 0:
                (state, history), losses = add_record(state, history, losses), []
            if checkpoints and (is_due or step + 1 == steps):
                save_checkpoint(checkpoints.folder, step + 1, checkpoints.recipe, state, (history, losses))
            if _out_of_patience(history, patience):
                break
        if losses:  # after the checkpoint: a training of more steps would not validate here
            state, history = add_record(state, history, losses)
    is_early = _out_of_patience(history, patience)
    ended = f"no gain in {patience} validations" if is_early else f"all {steps} steps are done"
    return Fit(state.best, _best(history).step, tuple(history), ended)


def _not_finite(what: str, step: int) -> TrainingError:
    return TrainingError(f"step {step}: {what} is not finite; look at the data, or lower the learning rate")


def _best(history: Sequence[Record]) -> Record:
    """The first record with the smallest validation; the last record without validation."""
    validations = [(record.validation, record.step, record) for record in history if record.validation is not None]
    return min(validations)[-1] if validations else history[-1]


def _out_of_patience(history: Sequence[Record], patience: int | None) -> bool:
    return patience is not None and len(history) - 1 - history.index(_best(history)) >= patience


def _strong(tree: Any) -> Any:
    """Arrays with strong types: a weak type would compile once more when a strong one takes its place."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(leaf)), tree)
