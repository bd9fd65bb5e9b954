"""Systems by name, with the declarations in conf/ that the programs read."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mfvpr.cli.command_line import compose, override
from mfvpr.cli.console import explain
from mfvpr.cli.schema import Evaluate
from mfvpr.evaluation import System
from mfvpr.systems import assembly
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values


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
    values = _read_run(Path(name), settings) if str(name).endswith(".json") else _compose(str(name), settings)
    checked = from_values(Evaluate, values)
    return assembly.system(checked, checked.previous_queries, checked.sequence)


def _compose(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    try:
        config = compose("evaluate", [override("system", name), *_overrides(settings)])
        return OmegaConf.to_container(config, resolve=True)  # pyright: ignore[reportReturnType]
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(explain(error)) from error


def _overrides(settings: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Settings in Hydra's grammar."""
    for name, value in settings.items():
        if f"{prefix}{name}" == "fusion.weights" and isinstance(value, Mapping):  # any names, but no group of settings
            yield f"fusion.weights={{{','.join(f'{scorer}:{weight}' for scorer, weight in value.items())}}}"
        elif isinstance(value, Mapping):
            yield from _overrides(value, f"{prefix}{name}.")
        elif isinstance(value, str):
            yield override(f"{prefix}{name}", value)
        else:
            yield f"{prefix}{name}={json.dumps(value, default=np.generic.item)}"


def _read_run(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    if settings:
        raise InputError(f"{path}: expected no other settings, got {', '.join(settings)}; load a system by name")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["settings"]
        if not {"scorer", "previous_queries"} <= {*values}:
            raise ValueError("another file")
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path}: expected the run.json of a run of mfvpr evaluate, got {error}") from error
    return values
