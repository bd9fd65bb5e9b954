"""The settings of a map in its folder, from which `Map.open` makes the system again."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.image_sizes import Note
from mfvpr.evaluation.system import System
from mfvpr.storage.manifest import MANIFEST
from mfvpr.storage.maps import has_rows
from mfvpr.systems import assembly
from mfvpr.systems.choices import check_system
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import write_text

LEARNING = "learning"  # the folder of features that a vocabulary is being learned from
_FILE, _FORMAT = "settings.json", "mfvpr map 1"
_ABOUT = 1.5  # relative difference of numbers of pixels: sides are rounded
_GROUPS = ("features", "retrieval", "matching", "scorer", "candidates")
_SCORE_ALONE = {"fusion": {"c": "auto", "weights": None, "retrieval_score": "cosine"}, "final": "score",
                "ties": "retrieval"}  # what a map means whose file lacks these  # fmt: skip


def read_declaration(folder: Path) -> dict[str, Any]:
    """The settings of the map in a folder; an InputError without one, or for a system that no settings describe."""
    path = folder / _FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content["format"] != _FORMAT or not {*_GROUPS} <= {*content}:
            raise ValueError
        settings = _SCORE_ALONE | {name: content[name] for name in (*_GROUPS, *_SCORE_ALONE) if name in content}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        raise InputError(f"{folder}: expected a folder with a map, got none ({_FILE} is missing, or another). Make one "
                         "with `mfvpr map build` or `Map.create`, or open a map of a system of your own with "
                         "`Map(folder, system)`.") from None  # fmt: skip
    try:
        check_system(settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return settings


def read_system(folder: Path) -> System:
    """The system that a map was made with; raises as `read_declaration`, or if weights are missing."""
    settings = read_declaration(folder)
    try:
        return assembly.system(settings)
    except InputError as error:
        raise InputError(f"{folder / _FILE}: {error}") from None


def fit_to_map(folder: Path, system: System, images: ImageFolder | None, note: Note) -> System:
    """The system at the image size of the map in a folder; in a new one, at that of the images, see `System`.

    Raises `InputError` if a new map has no images to take the shape from, or as `read_declaration`.
    """
    if system.pipeline.pixels is None:
        return system
    if system.settings is not None and (folder / _FILE).exists():
        width, height = read_declaration(folder)["features"]["image_size"]
        if not 1 / _ABOUT < width * height / system.pipeline.pixels < _ABOUT:
            got = f"{system.pipeline.pixels} pixels. Use features.image_size=[{width},{height}]."
            raise InputError(f"{folder}: this map was made with images of {width} x {height} px, got {got}")
        return system.with_image_size((width, height))
    if images is None:
        raise InputError("image_size: expected the images of a new map, whose shape decides, got none. Use "
                         "`Map.create`, or a system with features.image_size=[WIDTH,HEIGHT].")  # fmt: skip
    return system.fit_image_size([images], note)


def check_declaration(folder: Path, system: System) -> None:
    """Raise `InputError` if a folder has a map of other settings, or something else than a map."""
    if system.settings is None or not folder.is_dir():
        return
    if not (folder / _FILE).exists():
        names = {path.name for path in folder.iterdir() if not path.name.startswith(".")} - {"lock", LEARNING}
        if names and not ((folder / MANIFEST).exists() or has_rows(folder)):
            raise InputError(f"{folder}: expected a new or empty folder, or a map; name another")
    else:
        before, now = read_declaration(folder), _declaration(system.settings)
        if differing := [name for name in now if before[name] != now[name]]:
            raise InputError(f"{folder}: this map was made with other {' and '.join(differing)}. Name another folder, "
                             "or use what it was made with (`mfvpr map info`).")  # fmt: skip


def write_declaration(folder: Path, system: System) -> None:
    """Write the settings of a system that was made from settings, unless they are there; raises as the check."""
    if system.settings is not None and not (folder / _FILE).exists():
        content = {"format": _FORMAT} | _declaration(system.settings)
        write_text(folder / _FILE, json.dumps(content, indent=1, ensure_ascii=False) + "\n", once=True)
    check_declaration(folder, system)  # another process may have written it first


def _declaration(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: settings[name] for name in (*_GROUPS, *_SCORE_ALONE)}
