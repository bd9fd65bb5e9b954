"""Parse several data sets in one setting, each with its settings: `streets:seed=1,grief_season:root=DIR`."""

import re
from contextlib import nullcontext
from typing import Any, NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from experiments.groups import choices
from experiments.quoting import as_typed
from experiments.settings import CONF, SettingsError, check


class Named(NamedTuple):
    """A choice of the group `dataset`, and its settings as (name, value)."""

    choice: str
    values: list[tuple[str, str]]


def parse(setting: str, text: str) -> list[Named]:
    """The data sets of a text; values may contain commas and colons."""
    known = choices("dataset")
    parsed = []
    for item in re.split(rf",(?=(?:{'|'.join(known)})(?:[:,]|$))", text):
        choice, *pairs = re.split(r":(?=\w+=)", item)
        if choice not in known:
            raise SettingsError(f"{setting}={text}: expected data sets such as streets:seed=1,corridor:root=DIR, of "
                                f"{', '.join(known)}; got {choice}")  # fmt: skip
        parsed.append(Named(choice, [(name, value) for name, _, value in (pair.partition("=") for pair in pairs)]))
    return parsed


def first_of(arguments: list[str]) -> list[str]:
    """Split `dataset=A:x=1,B` into `dataset=A dataset.x=1 also=B`; keep other arguments."""
    changed = []
    for argument in arguments:
        setting, _, text = argument.partition("=")
        if setting == "dataset" and (":" in text or "," in text):
            first, *more = parse(setting, text)
            length = len(":".join([first.choice, *(f"{name}={value}" for name, value in first.values)]))
            changed += [f"dataset={first.choice}", *(f"dataset.{name}={value}" for name, value in first.values)]
            changed += [f"also={text[length + 1 :]}"] if more else []
        else:
            changed.append(argument)
    return changed


def composed(setting: str, text: str) -> list[dict[str, Any]]:
    """The settings of each data set, checked."""
    return [_compose(f"{setting}={text}", named) for named in parse(setting, text)]


def label(settings: dict[str, Any]) -> str:
    """Name of a data set; streets of different seeds get different names."""
    return f"{settings['name']} {settings['seed']}" if "seed" in settings else settings["name"]


def _compose(typed: str, named: Named) -> dict[str, Any]:
    choice = named.choice
    overrides = [as_typed(f"dataset.{name}={value}") for name, value in named.values]
    running = GlobalHydra.instance().is_initialized()
    with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        known = sorted(map(str, hydra.compose("learn", [f"dataset={choice}"]).dataset))
        for name, _ in named.values:
            if name not in known:
                raise SettingsError(f"{typed}: {choice} has no setting {name}; it has {', '.join(known)}")
        config = hydra.compose("learn", [f"dataset={choice}", *overrides]).dataset
    for name in known:
        if not OmegaConf.is_interpolation(config, name) and OmegaConf.is_missing(config, name):
            raise SettingsError(f"{typed}: {choice} has no default of {name}; write {choice}:{name}=VALUE")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    check({"dataset": settings})
    return settings
