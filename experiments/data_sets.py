"""Parse several data sets in one setting, each with its settings: `streets:seed=1,grief_season:root=DIR`."""

import re
from contextlib import nullcontext
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from experiments.groups import choices
from experiments.quoting import as_typed
from experiments.settings import CONF, SettingsError, check


def parse(setting: str, text: str) -> list[list[str]]:
    """The choice and the settings `name=value` of each data set of a text; values may contain commas and colons."""
    known = choices("dataset")
    parsed = [re.split(r":(?=\w+=)", part) for part in re.split(rf",(?=(?:{'|'.join(known)})(?:[:,]|$))", text)]
    for choice, *_ in parsed:
        if choice not in known:
            raise SettingsError(f"{setting}={text}: expected data sets such as streets:seed=1,corridor:root=DIR, of "
                                f"{', '.join(known)}; got {choice}")  # fmt: skip
    return parsed


def first_of(arguments: list[str]) -> list[str]:
    """Split `dataset=A:x=1,B` into `dataset=A dataset.x=1 also=B`; keep other arguments."""
    changed = []
    for argument in arguments:
        setting, _, text = argument.partition("=")
        if setting == "dataset" and (":" in text or "," in text):
            first, *more = parse(setting, text)
            changed += [f"dataset={first[0]}", *(f"dataset.{value}" for value in first[1:])]
            changed += [f"also={text[len(':'.join(first)) + 1 :]}"] if more else []
        else:
            changed.append(argument)
    return changed


def composed(setting: str, text: str) -> list[dict[str, Any]]:
    """The settings of each data set, checked."""
    return [_compose(f"{setting}={text}", *parts) for parts in parse(setting, text)]


def label(settings: dict[str, Any]) -> str:
    """Name of a data set; streets of different seeds get different names."""
    return f"{settings['name']} {settings['seed']}" if "seed" in settings else settings["name"]


def compose_program(config: str, overrides: list[str]) -> DictConfig:
    """The settings of a program with overrides in Hydra's grammar, also while Hydra runs."""
    running = GlobalHydra.instance().is_initialized()
    with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose(config, overrides)


def _compose(typed: str, choice: str, *values: str) -> dict[str, Any]:
    known = sorted(map(str, compose_program("learn", [f"dataset={choice}"]).dataset))
    for name in (value.partition("=")[0] for value in values):
        if name not in known:
            raise SettingsError(f"{typed}: {choice} has no setting {name}; it has {', '.join(known)}")
    overrides = [as_typed(f"dataset.{value}") for value in values]
    config = compose_program("learn", [f"dataset={choice}", *overrides]).dataset
    for name in known:
        if not OmegaConf.is_interpolation(config, name) and OmegaConf.is_missing(config, name):
            raise SettingsError(f"{typed}: {choice} has no default of {name}; write {choice}:{name}=VALUE")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    check({"dataset": settings})
    return settings
