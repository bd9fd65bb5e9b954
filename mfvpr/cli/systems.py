"""Systems by name, with the declarations in conf/ that the programs read."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from mfvpr.cli.command_line import hydra_errors
from mfvpr.cli.groups import check_choice, choices
from mfvpr.cli.overrides import compose_program, quote
from mfvpr.evaluation import System
from mfvpr.systems import assembly
from mfvpr.systems.settings import SettingsError, check, nodes, without_removed
from mfvpr.utils.errors import InputError

_PROGRAM = "config"  # its settings include those of systems


def load_system(name: str | Path = "mfvpr", **settings: Any) -> System:
    """A system by name, for `mfvpr.evaluate` and `mfvpr.Map`.

        system = mfvpr.load_system("mfvpr")
        system = mfvpr.load_system("mix_hist_50", candidates=20, scorer={"sigma": 15})
        system = mfvpr.load_system("steering", features="sift")
        system = mfvpr.load_system("runs/streets/2026-01-31_12-00-00/run.json")

    Args:
        name: as in `system=NAME` of the programs, or the run.json of a run.
        settings: other values than the system's: the choice of a group (text), a value, or values by name.

    Raises:
        InputError: an unknown name or setting, a value that is not allowed, or weights that are not installed; one line
            says what was expected.
    """
    try:
        values = _read_run(Path(name), settings) if str(name).endswith(".json") else _compose(str(name), settings)
        check(values)
        return assembly.system(values)
    except SettingsError as error:
        raise InputError(str(error)) from error


def _compose(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    overrides = {"system": name}
    for setting, value in nodes(settings):
        if not isinstance(value, Mapping):
            overrides[setting] = value if isinstance(value, str) else json.dumps(value, default=np.generic.item)
    for group in filter(choices, overrides):
        check_choice(group, overrides[group], _PROGRAM)
    arguments = [quote(f"{setting}={value}") for setting, value in overrides.items()]
    with hydra_errors(_PROGRAM, arguments):
        config = compose_program(_PROGRAM, arguments)
    return OmegaConf.to_container(config, resolve=True)  # pyright: ignore[reportReturnType]


def _read_run(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    if settings:
        raise SettingsError(f"{path}: expected no other settings, got {', '.join(settings)}; load a system by name")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["settings"]
        if not {"scorer", "cohort", "previous_queries"} <= {*values}:
            raise ValueError("another file")
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise SettingsError(f"{path}: expected the run.json of a run of mfvpr evaluate, got {error}") from error
    return without_removed(values)
