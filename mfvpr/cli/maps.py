"""Map folders of the programs, with the settings that they were made with."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.cli.console import track
from mfvpr.cli.stages import dataset_of
from mfvpr.evaluation import System
from mfvpr.localization import Map
from mfvpr.storage.disk import used_bytes
from mfvpr.systems import assembly
from mfvpr.systems.settings import SettingsError, check
from mfvpr.utils.files import expand_user, printable, write_text

SETTINGS = "settings.json"
_FORMAT = "mfvpr map 1"
_GROUPS = ("features", "retrieval", "matching", "scorer", "candidates")


def build_map(settings: Mapping[str, Any]) -> None:
    """Map the database of a data set."""
    robot_map = map_of_settings(settings)
    added = robot_map.build(dataset_of(settings["dataset"]).database, track=track("images"))
    print(f"{robot_map.folder}: {len(robot_map)} images, {added} of them new")


def print_map(folder: Path) -> None:
    """Print the number of images, the size on disk and the settings of a map."""
    settings, robot_map = read_settings(folder), open_map(folder)
    print(f"{folder}: {len(robot_map)} images, {used_bytes(folder) / 1e6:.1f} MB")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def add_images(folder: Path, images: list[Path], place: str | None) -> None:
    """Add image files to a map, one by one."""
    robot_map = open_map(folder)
    for path in images:
        robot_map.add(path, path.name if place is None else place)
        print(printable(f"{path}: added, {len(robot_map)} images"), flush=True)


def map_of_settings(settings: Mapping[str, Any]) -> Map:
    """The map in the folder of the settings, which is created if it is not there; its settings must be the same."""
    folder, map_settings = expand_user(settings["map"]), {name: settings[name] for name in _GROUPS}
    _check(map_settings)
    if (folder / SETTINGS).exists():
        _compare(folder, map_settings)
    elif folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise SettingsError(f"map={folder}: expected a new or empty folder, or a map; name another")
    robot_map = map_of(folder, map_settings)  # before settings.json is written, since it may fail
    text = json.dumps({"format": _FORMAT} | map_settings, indent=1, ensure_ascii=False) + "\n"
    write_text(folder / SETTINGS, text, once=True)
    _compare(folder, map_settings)  # another process may have written it first
    return robot_map


def open_map(folder: Path, **options: Any) -> Map:
    """The map in a folder, with options of `Map`."""
    return map_of(folder, read_settings(folder), **options)


def read_settings(folder: Path) -> dict[str, Any]:
    """The settings that a map was made with; a SettingsError if there is no map."""
    path = folder / SETTINGS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content["format"] != _FORMAT or not {*_GROUPS} <= {*content}:
            raise ValueError
    except (OSError, ValueError, KeyError):
        raise SettingsError(f"map={folder}: expected a folder with a map, got none ({SETTINGS} is missing, or "
                            "another); make one: mfvpr map build map=DIR") from None  # fmt: skip
    settings = {name: content[name] for name in _GROUPS}
    check(settings)
    return settings


def _compare(folder: Path, settings: Mapping[str, Any]) -> None:
    before = read_settings(folder)
    if differing := [name for name in _GROUPS if before[name] != settings[name]]:
        raise SettingsError(f"map={folder}: was made with other {' and '.join(differing)}; name another folder, or "
                            "set what it was made with (mfvpr map info)")  # fmt: skip


def _check(settings: Mapping[str, Any]) -> None:
    if "method" not in settings["scorer"]:
        raise SettingsError("scorer: expected one score, as scorer=histogram, got several")
    retrieval = settings["retrieval"]["name"]
    if retrieval in ("ssm", "pairs", "import") or settings["retrieval"].get("whiten"):
        raise SettingsError(f"retrieval={retrieval}: expected vlad, same or a network, without whiten")


def map_of(folder: Path, settings: Mapping[str, Any], **options: Any) -> Map:
    """The map in a folder, with these settings."""
    return Map(folder, System(assembly.pipeline({**settings}, None), assembly.scorers(settings["scorer"])), **options)
