"""Several data sets in one setting, each with settings of its own: `streets:seed=1,grief_season:root=DIR`."""

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
    """A choice of the group `dataset`, and what is set of it as (name, value)."""

    choice: str
    values: list[tuple[str, str]]


def named(setting: str, text: str) -> list[Named]:
    """The data sets of a text; commas and colons may stand in values."""
    known = choices("dataset")
    found = []
    for item in re.split(rf",(?=(?:{'|'.join(known)})(?:[:,]|$))", text):
        choice, *pairs = re.split(r":(?=\w+=)", item)
        if choice not in known:
            raise SettingsError(f"{setting}={text}: expected data sets such as streets:seed=1,corridor:root=DIR, of "
                                f"{', '.join(known)}; got {choice}")  # fmt: skip
        found.append(Named(choice, [(name, value) for name, _, value in (pair.partition("=") for pair in pairs)]))
    return found


def first_of(arguments: list[str]) -> list[str]:
    """`dataset=A:x=1,B` as `dataset=A dataset.x=1 also=B`; other arguments as they are."""
    changed = []
    for argument in arguments:
        setting, _, text = argument.partition("=")
        if setting == "dataset" and (":" in text or "," in text):
            first, *others = named(setting, text)
            own = f"{first.choice}{''.join(f':{name}={value}' for name, value in first.values)}"
            changed += [f"dataset={first.choice}", *(f"dataset.{name}={value}" for name, value in first.values)]
            changed += [f"also={text[len(own) + 1 :]}"] if others else []
        else:
            changed.append(argument)
    return changed


def composed(setting: str, text: str) -> list[dict[str, Any]]:
    """The settings of each data set, checked."""
    return [_composed(f"{setting}={text}", one) for one in named(setting, text)]


def label(settings: dict[str, Any]) -> str:
    """A name that differs between streets of different seeds."""
    return f"{settings['name']} {settings['seed']}" if "seed" in settings else settings["name"]


def _composed(typed: str, one: Named) -> dict[str, Any]:
    overrides = [as_typed(f"dataset.{name}={value}") for name, value in one.values]
    running = GlobalHydra.instance().is_initialized()
    with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        known = sorted(map(str, hydra.compose("learn", [f"dataset={one.choice}"]).dataset))
        for name, _ in one.values:
            if name not in known:
                raise SettingsError(f"{typed}: {one.choice} has no setting {name}; it has {', '.join(known)}")
        config = hydra.compose("learn", [f"dataset={one.choice}", *overrides]).dataset
    own = [name for name in known if not OmegaConf.is_interpolation(config, name)]
    if missing := [name for name in own if OmegaConf.is_missing(config, name)]:
        raise SettingsError(
            f"{typed}: {one.choice} has no default of {missing[0]}; write {one.choice}:{missing[0]}=VALUE"
        )
    settings: Any = OmegaConf.to_container(config, resolve=True)
    check({"dataset": settings})
    return settings
