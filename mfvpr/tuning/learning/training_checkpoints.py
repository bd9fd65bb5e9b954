"""Checkpoints of a training in a folder by Orbax: the last two, written atomically, with the training's recipe."""

import json
import logging
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from mfvpr.utils.errors import InputError
from mfvpr.utils.files import lock_folder


@contextmanager
def lock_checkpoints(folder: Path) -> Iterator[None]:
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
    checksum = zlib.crc32(json.dumps(progress).encode())
    for leaf in leaves:
        checksum = zlib.crc32(leaf.tobytes(), checksum)
    return checksum


def _reason(error: Exception) -> str:
    return " ".join(str(error).partition("[")[0].split())[:200]
