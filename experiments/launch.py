"""Runs a program under Hydra; what the user got wrong becomes one line and exit code 2."""

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from experiments.settings import SettingsError, check

CONF = Path(__file__).parent.parent / "conf"


def launch(program: Callable[[dict[str, Any]], None]) -> None:
    """`program(settings)` with the settings of conf/ and the command line, as plain and checked values."""

    def task(config: DictConfig) -> None:
        settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        check(settings)  # pyright: ignore[reportArgumentType]
        program(settings)  # pyright: ignore[reportArgumentType]

    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of printing and exiting with 1
    try:
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was left", file=sys.stderr)
        sys.exit(130)
    except MissingMandatoryValue as error:
        name = getattr(error, "full_key", None) or "a setting"
        _refuse(f"{name}: this setting has no default; give {name}=VALUE")
    except (HydraException, OmegaConfBaseException) as error:
        _refuse(_explain(error))
    except SettingsError as error:
        _refuse(str(error))
    except ValueError as error:
        from mfvpr.errors import InputError  # here, since it brings JAX along

        if not isinstance(error, InputError):
            raise
        _refuse(str(error))


def _refuse(reason: str) -> NoReturn:
    print(f"error: {reason}", file=sys.stderr)
    sys.exit(2)


def _explain(error: Exception) -> str:
    """One line of a Hydra message, with the nearest setting where one is unknown."""
    text = " ".join(str(error).split())
    unknown = re.search(r"Could not override '([^']*)'", text) or re.search(r"Key '([^']*)' is not in struct", text)
    if unknown:
        wrong = unknown.group(1)
        names = list(_setting_names())
        nearest = difflib.get_close_matches(wrong, names, n=1, cutoff=0.4)
        return f"{wrong}: unknown setting" + (f"; the nearest is {nearest[0]}" if nearest else "; see --help")
    return text


def _setting_names() -> Iterator[str]:
    """Every setting of the configuration that the command line's groups choose."""
    groups = [path.name for path in CONF.iterdir() if path.is_dir()]
    choices = [argument for argument in sys.argv[1:] if argument.partition("=")[0] in groups]
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            config = hydra.compose("config", choices)
    except HydraException:
        return
    pending = [("", config)]
    while pending:
        prefix, node = pending.pop()
        for name in node:
            child = node._get_node(name)
            yield f"{prefix}{name}"
            if isinstance(child, DictConfig) and not child._is_missing():
                pending.append((f"{prefix}{name}.", child))
