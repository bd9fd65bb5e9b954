"""The groups of conf/ that a program takes, and their choices; without Hydra, which takes a while to import."""

import difflib
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from experiments.settings import CONF, SettingsError

PROGRAMS = {
    "config": "evaluate",
    "sweep": "sweep",
    "learn": "learn",
    "paper": "paper",
    "map": "map build",
    "localize": "localize",
}  # by their file in conf/


def defaults(file: Path) -> list[Any]:
    """The defaults list of a file of conf/."""
    return _read(file).get("defaults", [])


@cache
def _read(file: Path) -> dict[str, Any]:
    return yaml.safe_load(file.read_text(encoding="utf-8")) or {}


def groups(config: str) -> dict[str, str | None]:
    """Group -> the choice that is made where the user makes none, of a program; `${scorer}` = that group's."""
    found: dict[str, str | None] = {}
    for entry in defaults(CONF / f"{config}.yaml"):
        if isinstance(entry, dict):
            entries = {group.removeprefix("optional "): choice for group, choice in entry.items()}
            found |= {group: choice for group, choice in entries.items() if (CONF / group).is_dir()}
        elif entry != "_self_":
            found |= groups(entry)
    return found


def choices(group: str) -> list[str]:
    """Of a group; none where there is no such group."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml")) if group.isidentifier() else []


def choices_with(group: str, name: str) -> list[str]:
    """The choices of a group that have a setting, but for those that are made of other choices, or other scores' with
    another value."""
    files = (CONF / group / f"{choice}.yaml" for choice in choices(group))
    own = (file for file in files if _read(file).get("method", file.stem) == file.stem)
    return [file.stem for file in own if name in _read(file) and not defaults(file)]


def check_choice(name: str, value: str, config: str) -> None:
    """Refuse a choice that a group does not have, and a group that a program does not take.

    Args:
        name: of a setting, which may be a group.
        value: as it was typed; several between commas.
        config: of the program.
    """
    known, own = choices(name), groups(config)
    if known and name not in own:
        if name in _read(CONF / f"{config}.yaml"):
            raise SettingsError(f"{name}={value}: this is a group of settings; set one of its members (see --help)")
        others = [program for other, program in PROGRAMS.items() if name in groups(other)]
        typed = " or ".join(f"python -m experiments.{program} {name}={value}" for program in others)
        raise SettingsError(f"{name}={value}: experiments.{PROGRAMS[config]} has no group {name}; type {typed}")
    for choice in value.split(",") if known else []:
        if choice not in known:
            nearest = difflib.get_close_matches(choice, known, n=1)
            hint = f"; the nearest is {nearest[0]}" if nearest else ""
            hint = "; leave it out for none" if choice == "null" and own[name] is None else hint
            raise SettingsError(f"{name}={value}: expected one of {', '.join(known)}{hint}")
