"""Checkpoints of a training in a folder: the last two, written atomically, with the recipe and the shapes of arrays."""

import json
import logging
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import difference
from mfvpr.utils.locks import lock_folder

FORMAT = "mfvpr training 2"
_KEPT = 2


@contextmanager
def lock_checkpoints(folder: Path) -> Iterator[None]:
    """Lock a folder of checkpoints, which is made if it is missing."""
    _holds_checkpoints(folder)
    in_use = InputError(f"{folder}: another process trains here; wait until it ends, or choose another folder")
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_folder(folder, in_use))
        except OSError as error:
            raise _disk_error(folder, "no checkpoint can be kept here", error) from None
        yield


def save_checkpoint(folder: Path, step: int, recipe: Mapping[str, Any], state: Any, progress: Any) -> None:
    """Write the pytree `state`, with JSON values, at a step above all earlier ones; remove all but the last two."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    arrays = {str(place): leaf for place, leaf in enumerate(leaves)}
    record = {**_description(recipe, state), "progress": progress, "checksum": _checksum(leaves, progress)}
    items = ocp.args.Composite(arrays=ocp.args.StandardSave(arrays), record=ocp.args.JsonSave(record))
    try:
        with _manager(folder) as manager:
            manager.save(step, args=items)
    except (OSError, ValueError, RuntimeError) as error:
        raise _disk_error(folder, f"the checkpoint of step {step} cannot be written", error) from None


def restore(folder: Path, recipe: Mapping[str, Any], state: Any) -> tuple[Any, Any] | None:
    """State and progress of the newest checkpoint, None without one; `state` has the same structure and shapes.

    An InputError for a folder of something else, another recipe or damage; nothing in the folder is changed.
    """
    if not _holds_checkpoints(folder):
        return None
    with _manager(folder, read_only=True) as manager:
        step = manager.latest_step()
        if step is None:
            return None
        where = folder / str(step)
        if not (where / "record").exists():
            raise InputError(f"{where}: expected a checkpoint of mfvpr, got another; choose another folder")
        record = _read(manager, where, record=ocp.args.JsonRestore())
        expected = _description(recipe, state)
        parts = (("format", "format"), ("recipe", ""), ("arrays", ""))
        differences = (difference(record.get(part, {}), expected[part], name) for part, name in parts)
        if differs := next(filter(None, differences), None):
            raise InputError(f"{folder}: this checkpoint is of {differs}; choose another folder, or delete this one")
        arrays = _read(manager, where, arrays=ocp.args.StandardRestore())
    leaves = [arrays[str(place)] for place in range(len(arrays))]
    if _checksum(leaves, record.get("progress")) != record.get("checksum"):
        raise _damage_error(where, "another checksum")
    return jax.tree.unflatten(jax.tree.structure(state), leaves), record["progress"]


def newest(folder: Path) -> Path | None:
    """The folder of the newest checkpoint, None without one."""
    steps = [int(path.name) for path in folder.iterdir() if path.name.isdecimal()]
    return folder / str(max(steps)) if steps else None


def leaves_by_path(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their path, `weight.hidden`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


@contextmanager
def _manager(folder: Path, read_only: bool = False) -> Iterator[ocp.CheckpointManager]:
    """Orbax's manager, without its logs and warnings."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings(action="ignore"):
            options = ocp.CheckpointManagerOptions(
                max_to_keep=None if read_only else _KEPT,
                enable_async_checkpointing=False,  # `save` returns when the checkpoint is on disk
                cleanup_tmp_directories=not read_only,
                save_root_metadata=False,
                read_only=read_only,
            )
            with ocp.CheckpointManager(folder.absolute(), options=options, item_names=("arrays", "record")) as manager:
                yield manager
    finally:
        logger.setLevel(level)


def _read(manager: ocp.CheckpointManager, where: Path, **item: Any) -> Any:
    """One item of the checkpoint in the folder `where`."""
    try:
        return manager.restore(int(where.name), args=ocp.args.Composite(**item))[next(iter(item))]
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise _damage_error(where, _reason(error)) from None


def _disk_error(folder: Path, problem: str, error: Exception) -> InputError:
    return InputError(f"{folder}: {problem} ({_reason(error)}); check the path, its permissions and its disk")


def _damage_error(where: Path, why: str) -> InputError:
    return InputError(f"{where}: damaged ({why}); delete it to go on from the checkpoint before")


def _checksum(leaves: Sequence[np.ndarray], progress: Any) -> int:
    checksum = zlib.crc32(json.dumps(progress).encode())
    for leaf in leaves:
        checksum = zlib.crc32(leaf.tobytes(), checksum)
    return checksum


def _holds_checkpoints(folder: Path) -> bool:
    """Whether there is a checkpoint; raises for a folder that holds something else."""
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of checkpoints, got a file; choose another folder")
    names = sorted(path.name for path in folder.iterdir())
    if foreign := [name for name in names if not name.partition(".orbax-checkpoint-tmp")[0].isdecimal()]:
        raise InputError(f"{folder}: expected a folder of checkpoints, got one that holds {foreign[0]}; choose another "
                         "folder")  # fmt: skip
    return bool(names)


def _description(recipe: Mapping[str, Any], state: Any) -> dict[str, Any]:
    """Format, recipe and shapes of arrays of a checkpoint, JSON values."""
    arrays = {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in leaves_by_path(state).items()}
    return json.loads(json.dumps({"format": FORMAT, "recipe": recipe or {}, "arrays": arrays}))  # tuples become lists


def _reason(error: Exception) -> str:
    return " ".join(str(error).partition("[")[0].split())[:200]
