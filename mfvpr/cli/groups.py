"""The groups of conf/ that a program has, and their choices; without Hydra, whose import is slow."""

import difflib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from mfvpr.systems.settings import CONF, SettingsError

# File in conf/ -> the command, and its job for `launch.import_job`.
PROGRAMS = {
    "config": ("mfvpr evaluate", "mfvpr.cli.evaluation:evaluate"),
    "sweep": ("mfvpr sweep", "mfvpr.cli.sweeping:sweep"),
    "learn": ("mfvpr learn", "mfvpr.cli.learning:learn"),
    "paper": ("python -m experiments.paper", "experiments.paper.program:paper"),
    "map": ("mfvpr map build", "mfvpr.cli.localization:build_map"),
    "localize": ("mfvpr localize", "mfvpr.cli.localization:localize"),
}
_STEERING_WEIGHTS = "aliked-n16"


def defaults(file: Path) -> list[Any]:
    """The defaults list of a file of conf/."""
    return _read(file).get("defaults", [])


@cache
def _read(file: Path) -> dict[str, Any]:
    return yaml.safe_load(file.read_text(encoding="utf-8")) or {}


def groups(config: str) -> dict[str, str | None]:
    """Groups of a program with their default choices; `${scorer}` = the choice of that group."""
    default_choices: dict[str, str | None] = {}
    for entry in defaults(CONF / f"{config}.yaml"):
        if isinstance(entry, dict):
            entries = {group.removeprefix("optional "): choice for group, choice in entry.items()}
            default_choices |= {group: choice for group, choice in entries.items() if (CONF / group).is_dir()}
        elif entry != "_self_":
            default_choices |= groups(entry)
    return default_choices


def choices(group: str) -> list[str]:
    """The choices of a group; empty if there is no such group."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml")) if group.isidentifier() else []


def choices_with(group: str, name: str) -> list[str]:
    """The choices of a group that have a setting, without those that combine or vary other choices."""
    files = {choice: CONF / group / f"{choice}.yaml" for choice in choices(group)}
    return [choice for choice, file in files.items() if name in _read(file) and not defaults(file)]


def aliked_or_sift(note: Callable[[str], object]) -> str:
    """The features of system=steering: ALIKED if its weights are installed, otherwise SIFT, which is noted."""
    from mfvpr.checkpoints import entry_of, is_installed  # here, since --help of other systems does without

    if is_installed(entry_of(_STEERING_WEIGHTS)):
        return "aliked"
    note(f"system=steering uses SIFT, because the weights {_STEERING_WEIGHTS} are not installed; with them it is more "
         "precise, see `mfvpr weights list`")  # fmt: skip
    return "sift"


def check_choice(name: str, value: str, config: str) -> None:
    """Raise a SettingsError if the program does not have this group of settings, or a value is no choice of it."""
    known, program_groups = choices(name), groups(config)
    if name not in program_groups:
        if name in _read(CONF / f"{config}.yaml"):
            raise SettingsError(f"{name}={value}: this is a group of settings; set one of its members (see --help)")
        commands = [command for other, (command, _) in PROGRAMS.items() if name in groups(other)]
        typed = " or ".join(f"{command} {name}={value}" for command in commands)
        raise SettingsError(f"{name}={value}: {PROGRAMS[config][0]} has no group {name}; type {typed}")
    for choice in value.split(","):
        if choice not in known:
            nearest = difflib.get_close_matches(choice, known, n=1)
            hint = f"; the nearest is {nearest[0]}" if nearest else ""
            hint = "; leave it out for none" if choice == "null" and program_groups[name] is None else hint
            raise SettingsError(f"{name}={value}: expected one of {', '.join(known)}{hint}")
