"""Checkpoints of a training in a folder: whole or not there at all, and never mistaken for those of another one.

Every checkpoint carries the recipe of what is trained, and the shapes of its arrays, and is compared with what is
expected before anything in the folder changes. The last two are kept.
"""

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
def held(folder: Path) -> Iterator[None]:
    """Keep other processes from training in a folder, which is made where it is not there; ends with the process.

    Raises:
        InputError: another process holds it, it holds something else, or it cannot be made.
    """
    _holds_checkpoints(folder)
    in_use = InputError(f"{folder}: another process trains here; wait until it ends, or choose another folder")
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_folder(folder, in_use))
        except OSError as error:
            raise InputError(
                f"{folder}: no checkpoint can be kept here ({_reason(error)}); "
                "check the path, its permissions and its disk"
            ) from None
        yield


def save(folder: Path, step: int, recipe: Mapping[str, Any], state: Any, progress: Any) -> None:
    """Write the checkpoint of a step, the newest, and drop all but the last two.

    Args:
        folder: is made where it is not there.
        step: above that of every checkpoint there.
        recipe: what is trained, JSON values.
        state: pytree of arrays.
        progress: JSON values that come back with the state.

    Raises:
        InputError: the disk is full, or cannot be written. Earlier checkpoints stay.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(state)]
    arrays = {str(place): leaf for place, leaf in enumerate(leaves)}
    record = {**_expected(recipe, state), "progress": progress, "checksum": _checksum(leaves, progress)}
    items = ocp.args.Composite(arrays=ocp.args.StandardSave(arrays), record=ocp.args.JsonSave(record))
    try:
        with _manager(folder) as manager:
            manager.save(step, args=items)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{folder}: the checkpoint of step {step} cannot be written ({_reason(error)}); "
            "check the path, its permissions and its disk"
        ) from None


def restore(folder: Path, recipe: Mapping[str, Any], state: Any) -> tuple[Any, Any] | None:
    """The newest checkpoint's state and progress; None where there is none. Nothing in the folder is changed.

    Args:
        folder: of `save`, may be missing.
        recipe: what is trained.
        state: pytree like the one that was saved.

    Raises:
        InputError: the folder holds something else, the checkpoint is of something else, or it is damaged.
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
        if differs := _difference(record, _expected(recipe, state)):
            raise InputError(f"{folder}: this checkpoint is of {differs}; choose another folder, or delete this one")
        arrays = _read(manager, where, arrays=ocp.args.StandardRestore())
    leaves = [arrays[str(place)] for place in range(len(arrays))]
    if _checksum(leaves, record.get("progress")) != record.get("checksum"):
        raise _damaged(where, "another checksum")
    return jax.tree.unflatten(jax.tree.structure(state), leaves), record["progress"]


def newest(folder: Path) -> Path | None:
    """The newest checkpoint, None where there is none."""
    steps = [int(path.name) for path in folder.iterdir() if path.name.isdecimal()]
    return folder / str(max(steps)) if steps else None


def named(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their path, `weight.hidden`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


@contextmanager
def _manager(folder: Path, read_only: bool = False) -> Iterator[ocp.CheckpointManager]:
    """Orbax, which says nothing of its own to the user."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings(action="ignore"):
            options = ocp.CheckpointManagerOptions(
                max_to_keep=None if read_only else _KEPT,
                enable_async_checkpointing=False,  # a checkpoint that is announced is there
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
        raise _damaged(where, _reason(error)) from None


def _damaged(where: Path, why: str) -> InputError:
    return InputError(f"{where}: damaged ({why}); delete it to go on from the checkpoint before")


def _checksum(leaves: Sequence[np.ndarray], progress: Any) -> int:
    checksum = zlib.crc32(json.dumps(progress).encode())
    for leaf in leaves:
        checksum = zlib.crc32(leaf.tobytes(), checksum)
    return checksum


def _holds_checkpoints(folder: Path) -> bool:
    """Whether there is something to restore; refuses to make anything but a new or empty folder one of checkpoints."""
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of checkpoints, got a file; choose another folder")
    names = sorted(path.name for path in folder.iterdir())
    if foreign := [name for name in names if not name.partition(".orbax-checkpoint-tmp")[0].isdecimal()]:
        raise InputError(
            f"{folder}: expected a folder of checkpoints, got one that holds {foreign[0]}; choose another folder"
        )
    return bool(names)


def _expected(recipe: Mapping[str, Any], state: Any) -> dict[str, Any]:
    """What a checkpoint says that it is of."""
    arrays = {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in named(state).items()}
    return json.loads(json.dumps({"format": FORMAT, "recipe": recipe or {}, "arrays": arrays}))  # tuples become lists


def _difference(found: Mapping[str, Any], expected: Mapping[str, Any]) -> str | None:
    """The first thing that differs, see `fingerprints.difference`; the recipe before the arrays."""
    parts = (("format", "format"), ("recipe", ""), ("arrays", ""))
    differences = (difference(found.get(part, {}), expected[part], name) for part, name in parts)
    return next(filter(None, differences), None)


def _reason(error: Exception) -> str:
    return " ".join(str(error).partition("[")[0].split())[:200]
