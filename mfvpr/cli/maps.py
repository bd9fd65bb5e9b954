"""Map folders of the programs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.cli.console import track
from mfvpr.cli.inputs import dataset_of
from mfvpr.localization import Map
from mfvpr.localization.declaration import read_declaration
from mfvpr.storage.disk import used_bytes
from mfvpr.systems import assembly
from mfvpr.utils.files import expand_user, printable


def build_map(settings: dict[str, Any]) -> None:
    """Map the database of a data set."""
    robot_map = map_of_settings(settings)
    added = robot_map.build(dataset_of(settings["dataset"]).database, track=track("images"))
    print(f"{robot_map.folder}: {len(robot_map)} images, {added} of them new")


def print_map(folder: Path) -> None:
    """Print the number of images, the size on disk and the settings of a map."""
    settings, robot_map = read_declaration(folder), Map.open(folder)
    print(f"{folder}: {len(robot_map)} images, {used_bytes(folder) / 1e6:.1f} MB")
    print(json.dumps(settings, indent=1, ensure_ascii=False))


def add_images(folder: Path, images: list[Path], place: str | None) -> None:
    """Add image files to a map, one by one."""
    robot_map = Map.open(folder)
    for path in images:
        robot_map.add(path, path.name if place is None else place)
        print(printable(f"{path}: added, {len(robot_map)} images"), flush=True)


def map_of_settings(settings: Mapping[str, Any]) -> Map:
    """The map in the folder of the settings, which may be missing or empty."""
    system = assembly.system({**settings, "cohort": None, "previous_queries": 0})
    return Map(expand_user(settings["map"]), system)
