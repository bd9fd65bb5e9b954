"""The settings of a map in its file, from which `Map.open` makes the system again."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.datasets.datasets import ImageFolder
from mfvpr.evaluation.system import Note, System
from mfvpr.storage.maps import MapFile
from mfvpr.systems import assembly
from mfvpr.systems.choices import SystemSettings
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values

_ABOUT = 1.5  # relative difference of numbers of pixels: sides are rounded
_DECLARED = ("features", "retrieval", "matching", "scorer", "candidates", "fusion", "final", "ties")


def declaration(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a system that a map keeps."""
    return json.loads(json.dumps({name: settings[name] for name in _DECLARED}))  # tuples become lists


def read_declaration(folder: Path) -> dict[str, Any]:
    """The settings of the map in a folder; an InputError without one, or for a system that no settings describe."""
    content = MapFile(Path(folder)).part("system")
    if content is None:
        fix = "Make one with `mfvpr map build` or `Map.create`"
        open_map = "open a map of a system of your own with `Map(folder, system)`"
        raise InputError(f"{folder}: expected a folder with a map, got none. {fix}, or {open_map}.")
    settings = json.loads(content)
    try:
        from_values(SystemSettings, settings)
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None
    return settings


def read_system(folder: Path) -> System:
    """The system that a map was made with; raises as `read_declaration`, or if weights are missing."""
    settings = read_declaration(folder)
    try:
        return assembly.system(from_values(SystemSettings, settings))
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def check_declaration(file: MapFile, system: System) -> None:
    """Raise `InputError` if a map has other settings."""
    content = None if system.settings is None else file.part("system")
    if system.settings is not None and content is not None:
        before, now = json.loads(content), declaration(system.settings)
        if differing := " and ".join(name for name in now if before.get(name) != now[name]):
            fix = "Name another folder, or use what it was made with (`mfvpr map info`)"
            raise InputError(f"{file.folder}: this map was made with other {differing}. {fix}.")


def fit_to_map(folder: Path, system: System, images: ImageFolder | None, note: Note) -> System:
    """The system at the image size of the map in a folder; in a new one, at that of the images, see `System`.

    Raises `InputError` if a new map has no images to take the shape from, or as `read_declaration`.
    """
    if system.pipeline.pixels is None:
        return system
    if system.settings is not None and MapFile(Path(folder)).part("system") is not None:
        width, height = read_declaration(folder)["features"]["image_size"]
        if not 1 / _ABOUT < width * height / system.pipeline.pixels < _ABOUT:
            got = f"{system.pipeline.pixels} pixels. Use features.image_size=[{width},{height}]"
            raise InputError(f"{folder}: this map was made with images of {width} x {height} px, got {got}.")
        return system.with_image_size((width, height))
    if images is None:
        fix = "Use `Map.create`, or a system with features.image_size=[WIDTH,HEIGHT]"
        raise InputError(f"image_size: expected the images of a new map, whose shape decides, got none. {fix}.")
    return system.fit_image_size([images], note)
