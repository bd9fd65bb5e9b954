"""A run that several tasks share, on one machine or many: its folder knows its settings, and how far each task is.

    DIR/shards/run.json          settings and number of the shards: made once, compared by every task
    DIR/shards/data.json         what the images hold, likewise
    DIR/shards/2-of-8/state.json what a task said last
    DIR/shards/2-of-8/lock       held while it works

What is computed lies in the stores; the results are in DIR, when the last task has left them there.
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
from mfvpr.storage.disk import locked
from mfvpr.utils.files import write_text, written_once
from mfvpr.utils.fingerprints import difference
from mfvpr.utils.locks import is_locked
from mfvpr.utils.versions import versions

SHARDS = "shards"
COMPLETE = "complete"
_FORMAT = "mfvpr shards 1"
_STATE = "state.json"
# What may differ from machine to machine. Images are compared by what they hold.
_OWN = ("shard", "wait", "coordinator", "out", "store", "memory", "devices", "dataset", "multirun", "command")


@contextmanager
def joined(settings: Mapping[str, Any]) -> Iterator[None]:
    """A task of a run, which no other process does meanwhile.

    Raises:
        SettingsError: the folder is of a run with other settings, or of another number of shards.
        InputError: the same shard is at work.
    """
    shard, folder = Shard.parse(settings["shard"]), task_folder(settings).parent
    own = {name: value for name, value in settings.items() if name not in _OWN}
    _check_empty(folder)
    about = {"shards": shard.count, "dataset": settings["dataset"]["name"], "settings": own}
    about["store"] = _identity(build.expanded(settings["store"]))
    _agreed(folder / "run.json", about, f"shard={shard}")
    task = task_folder(settings)
    task.mkdir(parents=True, exist_ok=True)
    with locked(task, "the part of a run"):
        yield


def _check_empty(folder: Path) -> None:
    """That the first task finds nothing of others."""
    if (folder / "run.json").exists() or not folder.parent.is_dir():
        return
    if found := sorted(path.name for path in folder.parent.iterdir() if path.name != SHARDS):
        raise SettingsError(f"out={folder.parent}: expected a new or empty folder, or that of other shards of this "
                            f"run, got one that holds {found[0]}; name another")  # fmt: skip


def _identity(store: Path) -> str:
    """What tells a folder of stores from one of the same path on another machine, whose rows nobody else would see."""
    try:
        return written_once(store / "identity", uuid.uuid4().hex)
    except OSError as error:
        raise SettingsError(f"store={store}: cannot be written or read ({error.strerror}); name another") from error


def task_folder(settings: Mapping[str, Any]) -> Path:
    """What a task keeps of itself."""
    return _folder(build.expanded(settings["out"])) / Shard.parse(settings["shard"]).folder


def wait(settings: Mapping[str, Any], needs: NotYet) -> None:
    """Keep what this task waits for; others that were complete, and are needed again (damaged rows go), are not."""
    own = task_folder(settings)
    write_text(own / _STATE, json.dumps({"state": COMPLETE if needs.is_complete else f"ended, waiting for {needs}"}))
    shard = Shard.parse(settings["shard"])
    for index in needs.shards:
        other = own.parent / Shard(index, shard.count).folder
        if _state(other) == COMPLETE:
            write_text(other / _STATE, json.dumps({"state": f"something is missing again, says {shard}"}))


def complete(settings: Mapping[str, Any]) -> None:
    """Keep that this task has nothing left to do."""
    write_text(task_folder(settings) / _STATE, json.dumps({"state": COMPLETE}))


def check_data(settings: Mapping[str, Any], images: Images) -> None:
    """That all tasks see the same images and the same ground truth, with the same versions.

    Raises:
        SettingsError: another task has seen others.
    """
    if settings.get("shard") is None:
        return
    known = images.dataset.sequences[0].truth
    right = truth.fingerprint(images.dataset, truth.thresholds(settings, known))
    about = {"images": images.fingerprints, "ground truth": right, "versions": versions()}
    folder = _folder(build.expanded(settings["out"]))
    _agreed(folder / "data.json", about, f"shard={settings['shard']}")


@contextmanager
def last(settings: Mapping[str, Any]) -> Iterator[bool]:
    """Whether the results are still to be written; for one task at a time."""
    folder = build.expanded(settings["out"])
    with locked(_folder(folder), "a run", lambda line: None):
        yield not (folder / runs.LAST).exists()


def _folder(out: Path) -> Path:
    return out / SHARDS


def _agreed(path: Path, about: Mapping[str, Any], who: str) -> None:
    """That this is what the first task wrote."""
    about = {"format": _FORMAT, **about}
    try:
        found = read(path, written_once(path, json.dumps(about, indent=1, ensure_ascii=True, allow_nan=False)))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written or read ({error.strerror}); name another out=DIR") from error
    if (own := about.get("store")) != found.get("store"):
        raise SettingsError(f"{who}: expected the store= of the task that came first, got another folder ({own}); all "
                            "tasks share one, on whatever machine")  # fmt: skip
    if differs := difference(json.loads(json.dumps(about)), found):
        raise SettingsError(f"{who}: {differs} by the task that came first ({path}); set that, or name another out=DIR")


def read(path: Path, text: str | None = None) -> dict[str, Any]:
    """What a file of a run's shards says.

    Raises:
        SettingsError: it is none.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8") if text is None else text)
        if found["format"] == _FORMAT:
            Shard(0, int(found.get("shards", 1)))
            return found
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass
    raise SettingsError(f"{path}: expected a file of a run with shard=i/n and out=DIR, got none, or something else")


def states(out: Path) -> list[str]:
    """What each task of a run says of itself, by number.

    Raises:
        SettingsError: there is no such run.
    """
    about = read(_folder(out) / "run.json")
    return [_state(_folder(out) / Shard(index, about["shards"]).folder) for index in range(about["shards"])]


def missing(out: Path) -> list[int]:
    """Numbers of the tasks that are to be started; the first of all where only the results are missing."""
    found = states(out)
    if (out / runs.LAST).exists():
        return []
    return [index for index, state in enumerate(found) if state != COMPLETE] or [0]


def _state(task: Path) -> str:
    if is_locked(task / "lock"):
        return "at work"
    try:
        return str(json.loads((task / _STATE).read_text(encoding="utf-8"))["state"])
    except FileNotFoundError:
        return "interrupted" if task.exists() else "not begun"
    except (OSError, ValueError, LookupError, TypeError):
        return "interrupted"
