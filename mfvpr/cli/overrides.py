"""Typed settings as Hydra's overrides: quoted values, and data sets as `streets:seed=1,corridor:root=DIR`."""

import re
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from mfvpr.cli.groups import aliked_or_sift, choices
from mfvpr.systems.settings import CONF, SettingsError, check

PATHS = {"dataset.database", "dataset.queries", "dataset.root", "dataset.index_file", "dataset.cache"}
PATHS |= {"dataset.database_labels", "dataset.query_labels", "map", "images"}
PATHS |= {"cache", "out", "checkpoints", "confidence", "also", "report"}
PATHS |= {f"{group}.{side}" for group in ("features", "retrieval") for side in ("database", "queries")}


def register_resolvers(note: Callable[[str], object]) -> None:
    """Let `${aliked_or_sift:}` in conf/ choose features by the installed weights; a line about it goes to `note`."""
    OmegaConf.register_new_resolver("aliked_or_sift", lambda: aliked_or_sift(note), replace=True)


register_resolvers(warnings.warn)  # in the library; programs register `tell`


def quote(argument: str, *, several: bool = False) -> str:
    """Quote the value of a typed setting if Hydra's grammar would reject it (paths, mostly).

    Paths may stand in a list; if `several`, in a multirun, also between commas.
    """
    name, equals, value = argument.partition("=")
    is_path = name in PATHS and value not in ("", "null") and value[0] not in "'\""
    if not equals or argument.startswith("-") or not (is_path or _unparsable(argument)):
        return argument
    for special in ("\\", "'", "${"):
        value = value.replace(special, f"\\{special}")
    is_list = is_path and value[0] == "[" and value[-1] == "]"
    if is_list:
        value = value[1:-1]
    parts = value.split(",") if is_list or (several and is_path) else [value]
    quoted = ",".join(f"'{part}'" for part in parts)
    return f"{name}=[{quoted}]" if is_list else f"{name}={quoted}"


def _unparsable(argument: str) -> bool:
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return True
    return False


def parse_data_sets(setting: str, text: str) -> list[list[str]]:
    """The choice and the settings `name=value` of each data set of a text; values may contain commas and colons."""
    known = choices("dataset")
    parsed = [re.split(r":(?=\w+=)", part) for part in re.split(rf",(?=(?:{'|'.join(known)})(?:[:,]|$))", text)]
    for choice, *_ in parsed:
        if choice not in known:
            raise SettingsError(f"{setting}={text}: expected data sets such as streets:seed=1,corridor:root=DIR, of "
                                f"{', '.join(known)}; got {choice}")  # fmt: skip
    return parsed


def split_first(arguments: list[str]) -> list[str]:
    """Split `dataset=A:x=1,B` into `dataset=A dataset.x=1 also=B`; keep other arguments."""
    changed = []
    for argument in arguments:
        setting, _, text = argument.partition("=")
        if setting == "dataset" and (":" in text or "," in text):
            first, *more = parse_data_sets(setting, text)
            changed += [f"dataset={first[0]}", *(f"dataset.{value}" for value in first[1:])]
            changed += [f"also={text[len(':'.join(first)) + 1 :]}"] if more else []
        else:
            changed.append(argument)
    return changed


def compose_data_sets(setting: str, text: str) -> list[dict[str, Any]]:
    """The settings of each data set, checked."""
    return [_compose(f"{setting}={text}", *parts) for parts in parse_data_sets(setting, text)]


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
    overrides = [quote(f"dataset.{value}") for value in values]
    config = compose_program("learn", [f"dataset={choice}", *overrides]).dataset
    for name in known:
        if not OmegaConf.is_interpolation(config, name) and OmegaConf.is_missing(config, name):
            raise SettingsError(f"{typed}: {choice} has no default of {name}; write {choice}:{name}=VALUE")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    check({"dataset": settings})
    return settings
