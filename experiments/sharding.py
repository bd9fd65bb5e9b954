"""The folder of a run that is split into shards: its settings, and the state of each task.

    DIR/shards/run.json          settings and number of shards: written once, compared by every task
    DIR/shards/data.json         fingerprints of images and ground truth, versions: likewise
    DIR/shards/2-of-8/state.json state that a task wrote last
    DIR/shards/2-of-8/lock       locked while the task works

Features, matches and scores are in the stores; the last task writes the results to DIR.
"""

import json
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from experiments import build, truth
from experiments.settings import SettingsError
from experiments.stages import Images
from mfvpr.report import runs
from mfvpr.storage import NotYet, Shard
from mfvpr.storage.disk import lock_store
from mfvpr.utils.files import write_text, written_once
from mfvpr.utils.fingerprints import difference
from mfvpr.utils.locks import is_locked
from mfvpr.utils.versions import versions

SHARDS = "shards"
COMPLETE = "complete"
_FORMAT = "mfvpr shards 1"
_STATE = "state.json"
# Settings that may differ from machine to machine. Images are compared by their content.
_LOCAL = ("shard", "wait", "coordinator", "out", "store", "memory", "devices", "dataset", "multirun", "command")


@contextmanager
def join_run(settings: Mapping[str, Any]) -> Iterator[None]:
    """Take part in a run as the task of `shard`, and lock the task.

    Raises:
        SettingsError: the folder belongs to a run with other settings, or with another number of shards.
        InputError: another process works on the same shard.
    """
    shard, folder = Shard.parse(settings["shard"]), task_folder(settings).parent
    shared = {name: value for name, value in settings.items() if name not in _LOCAL}
    _check_empty(folder)
    content = {"shards": shard.count, "dataset": settings["dataset"]["name"], "settings": shared}
    content["store"] = _identity(build.expand_user(settings["store"]))
    _compare(folder / "run.json", content, f"shard={shard}")
    task = task_folder(settings)
    task.mkdir(parents=True, exist_ok=True)
    with lock_store(task, "the part of a run"):
        yield


def _check_empty(folder: Path) -> None:
    """Refuse a folder that is neither empty nor of a run with shards."""
    if (folder / "run.json").exists() or not folder.parent.is_dir():
        return
    if names := sorted(path.name for path in folder.parent.iterdir() if path.name != SHARDS):
        raise SettingsError(f"out={folder.parent}: expected a new or empty folder, or that of other shards of this "
                            f"run, got one that holds {names[0]}; name another")  # fmt: skip


def _identity(store: Path) -> str:
    """A number that tells a folder of stores from a folder of the same path on another machine."""
    try:
        return written_once(store / "identity", uuid.uuid4().hex)
    except OSError as error:
        raise SettingsError(f"store={store}: cannot be written or read ({error.strerror}); name another") from error


def task_folder(settings: Mapping[str, Any]) -> Path:
    """The folder of a task: its state and its lock."""
    return _folder(build.expand_user(settings["out"])) / Shard.parse(settings["shard"]).folder


def mark_waiting(settings: Mapping[str, Any], needs: NotYet) -> None:
    """Write that this task waits; complete tasks that it waits for, because of damaged rows, are no longer complete."""
    folder = task_folder(settings)
    write_text(folder / _STATE, json.dumps({"state": COMPLETE if needs.is_complete else f"ended, waiting for {needs}"}))
    shard = Shard.parse(settings["shard"])
    for index in needs.shards:
        other = folder.parent / Shard(index, shard.count).folder
        if _state(other) == COMPLETE:
            write_text(other / _STATE, json.dumps({"state": f"something is missing again, says {shard}"}))


def mark_complete(settings: Mapping[str, Any]) -> None:
    """Write that this task has nothing left to do."""
    write_text(task_folder(settings) / _STATE, json.dumps({"state": COMPLETE}))


def check_data(settings: Mapping[str, Any], images: Images) -> None:
    """Check that all tasks have the same images, ground truth and versions.

    Raises:
        SettingsError: another task has different ones.
    """
    if settings.get("shard") is None:
        return
    thresholds = truth.thresholds(settings, images.dataset.sequences[0].truth)
    ground_truth = truth.fingerprint(images.dataset, thresholds)
    content = {"images": images.fingerprints, "ground truth": ground_truth, "versions": versions()}
    folder = _folder(build.expand_user(settings["out"]))
    _compare(folder / "data.json", content, f"shard={settings['shard']}")


@contextmanager
def claim_results(settings: Mapping[str, Any]) -> Iterator[bool]:
    """Whether the results are still to be written, for one task at a time."""
    folder = build.expand_user(settings["out"])
    with lock_store(_folder(folder), "a run", lambda line: None):
        yield not (folder / runs.LAST).exists()


def _folder(out: Path) -> Path:
    return out / SHARDS


def _compare(path: Path, content: Mapping[str, Any], task: str) -> None:
    """Write a file of a run, or compare its content with the file that the first task wrote."""
    content = {"format": _FORMAT, **content}
    try:
        first = read(path, written_once(path, json.dumps(content, indent=1, ensure_ascii=True, allow_nan=False)))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written or read ({error.strerror}); name another out=DIR") from error
    if (store := content.get("store")) != first.get("store"):
        raise SettingsError(f"{task}: expected the store= of the task that came first, got another folder ({store}); "
                            "all tasks share one, on whatever machine")  # fmt: skip
    if differs := difference(json.loads(json.dumps(content)), first):
        raise SettingsError(
            f"{task}: {differs} by the task that came first ({path}); set that, or name another out=DIR"
        )


def read(path: Path, text: str | None = None) -> dict[str, Any]:
    """The content of a file of a run with shards.

    Raises:
        SettingsError: it is another file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8") if text is None else text)
        if content["format"] == _FORMAT:
            Shard(0, int(content.get("shards", 1)))
            return content
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass
    raise SettingsError(f"{path}: expected a file of a run with shard=i/n and out=DIR, got none, or something else")


def states(out: Path) -> list[str]:
    """The state of each task of a run, by index.

    Raises:
        SettingsError: there is no such run.
    """
    count = read(_folder(out) / "run.json")["shards"]
    return [_state(_folder(out) / Shard(index, count).folder) for index in range(count)]


def missing(out: Path) -> list[int]:
    """Indices of the tasks that are to be started; the first task if only the results are missing."""
    task_states = states(out)
    if (out / runs.LAST).exists():
        return []
    return [index for index, state in enumerate(task_states) if state != COMPLETE] or [0]


def _state(task: Path) -> str:
    if is_locked(task / "lock"):
        return "at work"
    try:
        return str(json.loads((task / _STATE).read_text(encoding="utf-8"))["state"])
    except FileNotFoundError:
        return "interrupted" if task.exists() else "not begun"
    except (OSError, ValueError, LookupError, TypeError):
        return "interrupted"
