"""Maps of the programs: a folder that knows the settings it was made with."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments import build
from experiments.settings import SettingsError, check
from mfvpr.features import Aggregated
from mfvpr.localization import Map
from mfvpr.utils.files import written_once

SETTINGS = "settings.json"
_FORMAT = "mfvpr map 1"
_GROUPS = ("features", "retrieval", "matching", "scorer", "candidates")


def made(settings: Mapping[str, Any]) -> Map:
    """The map that settings name, a new one or one of the same settings.

    Raises:
        SettingsError: the folder has a map of other settings, or none can be made with these.
    """
    folder, own = build.expanded(settings["map"]), {name: settings[name] for name in _GROUPS}
    _check(own)
    is_foreign = folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())
    if (folder / SETTINGS).exists():
        _compare(folder, own)
    elif is_foreign:
        raise SettingsError(f"map={folder}: expected a new or empty folder, or a map; name another")
    opened = map_of(folder, own)  # before the settings, which then are of a map that can be
    written_once(folder / SETTINGS, json.dumps({"format": _FORMAT} | own, indent=1, ensure_ascii=False) + "\n")
    _compare(folder, own)  # another process may have begun a map here
    return opened


def opened(folder: Path, **options: Any) -> Map:
    """A map that is there; options as of `Map`."""
    return map_of(folder, read(folder), **options)


def read(folder: Path) -> dict[str, Any]:
    """The settings that a map was made with.

    Raises:
        SettingsError: there is no map.
    """
    path = folder / SETTINGS
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict) or found["format"] != _FORMAT or not {*_GROUPS} <= {*found}:
            raise ValueError
    except (OSError, ValueError, KeyError):
        raise SettingsError(f"map={folder}: expected a folder with a map, got none ({SETTINGS} is missing, or "
                            "another); make one: python -m experiments.map build map=DIR") from None  # fmt: skip
    own = {name: found[name] for name in _GROUPS}
    check(own)
    return own


def _compare(folder: Path, own: Mapping[str, Any]) -> None:
    """Refuse settings that a map was not made with."""
    before = read(folder)
    if differing := [name for name in _GROUPS if before[name] != own[name]]:
        raise SettingsError(f"map={folder}: was made with other {' and '.join(differing)}; name another folder, or "
                            "set what it was made with (python -m experiments.map info)")  # fmt: skip


def _check(settings: Mapping[str, Any]) -> None:
    if settings["features"]["name"] == "import":
        raise SettingsError("features=import: a map takes features of images itself; choose others")
    if "method" not in settings["scorer"]:
        raise SettingsError("scorer: expected one score, as scorer=histogram, got several")
    if settings["candidates"] == "all":
        raise SettingsError("candidates=all: a map matches so many, whatever it holds; set a number")
    retrieval = settings["retrieval"]["name"]
    if retrieval in ("ssm", "pairs", "import") or settings["retrieval"].get("whiten"):
        raise SettingsError(f"retrieval={retrieval}: expected vlad, same or a network, without whiten")


def map_of(folder: Path, settings: Mapping[str, Any], **options: Any) -> Map:
    extractor: Any = build.extractor(settings["features"], None)  # not of files
    filter: Any = build.filter(settings["retrieval"], extractor, None)  # with a describer, as all that are left
    describer: Any = filter.describer
    describer = describer.fitting if isinstance(describer, Aggregated) else describer
    [scorer] = build.scorers(settings["scorer"]).values()
    return Map(folder, extractor, describer, scorer=scorer, matcher=build.matching(settings["matching"]),
               candidates=settings["candidates"], **options)  # fmt: skip
