"""Run a program with settings: Hydra composes them, a dataclass checks them, and the job gets them."""

import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mfvpr.checkpoints import entry_of, is_installed
from mfvpr.cli import schema
from mfvpr.cli.console import one_line, tell
from mfvpr.systems.choices import CONF, without
from mfvpr.utils.cluster import Cluster
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values

Job = Callable[[Any], None]  # of the settings of its program
_STEERING_WEIGHTS = "aliked-n16"


def run(program: str, find_job: Callable[[], Job], command: str) -> None:
    """Run the job of a program once, or with `--multirun` for each combination of values."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors
    warnings.filterwarnings("ignore", "A worker stopped")  # joblib renews a worker that has grown
    arguments = sys.argv[1:]
    schema.register()

    def task(composed: DictConfig) -> None:
        about = HydraConfig.get()
        if about.mode != RunMode.MULTIRUN:
            with one_line():  # in here, or Hydra adds lines to the error
                run_job(composed, arguments, None)
            return
        typed = [*about.overrides.task]
        tell(f"job {about.job.num}: {' '.join(typed)}")
        overrides = dict(override.split("=", 1) for override in typed)
        run_job(composed, typed, {"multirun": about.sweep.dir, "number": about.job.num, "overrides": overrides})

    def run_job(composed: DictConfig, typed: list[str], multirun: dict[str, Any] | None) -> None:
        settings = checked(program, composed)
        job = find_job()
        _set_up_jax(settings.compiled)
        if not isinstance(settings, schema.Common):
            job(settings)
            return
        shown = shlex.join(argument for argument in typed if not argument.startswith("launcher="))
        with _cluster(settings.cluster) as workers:
            job(replace(settings, command=f"{command} {shown}", multirun=multirun, workers=workers))

    hydra.main(version_base="1.3", config_path=str(CONF), config_name=program)(task)()


def checked(program: str, composed: DictConfig) -> Any:
    """Composed settings as the dataclass of the program, if they are allowed."""
    values: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    return from_values(schema.PROGRAMS[program], values)


@contextmanager
def _cluster(settings: Mapping[str, Any]) -> Iterator[Cluster | None]:
    """Connect to the cluster that the settings name, or start it, until the block ends."""
    if not settings:
        yield None
        return
    starts = {"address": Cluster.connect, "local": Cluster.local, "slurm": Cluster.slurm}
    with starts[settings["name"]](**without(settings, "name")) as started:
        tell(f"cluster: {started}")
        yield started


def compose(program: str, overrides: list[str]) -> DictConfig:
    """The settings of a program with overrides in Hydra's grammar, also while Hydra runs."""
    schema.register()
    running = GlobalHydra.instance().is_initialized()
    with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose(program, overrides)


def compose_data_set(setting: str, name: str, values: dict[str, Any]) -> dict[str, Any]:
    """The checked settings of a data set, by its choice and the values of some of its settings."""
    config = compose("learn", [f"dataset={name}"]).dataset
    for key, value in values.items():
        if key not in [*config]:
            raise InputError(f"{setting}: {name} has no setting {key}; it has {', '.join(map(str, config))}")
        config[key] = value
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise InputError(f"{setting}: dataset.{missing[0]}: expected a value of {name}")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    schema.check_data_set(settings)
    return settings


def compose_data_sets(setting: str, data_sets: list[Any]) -> list[dict[str, Any]]:
    """The checked settings of data sets such as `streets` or `{corridor: {root: DIR}}`."""
    chosen = ({each: {}} if isinstance(each, str) else each for each in data_sets)
    return [compose_data_set(setting, name, values or {}) for each in chosen for name, values in each.items()]


def override(name: str, value: Any) -> str:
    """An override of text in Hydra's grammar."""
    escaped = str(value).replace("'", "\\'").replace("${", "\\${")
    return f"{name}='{escaped}'"


def aliked_or_sift() -> str:
    """The features of system=steering: ALIKED if its weights are installed, otherwise SIFT, with a warning."""
    if is_installed(entry_of(_STEERING_WEIGHTS)):
        return "aliked"
    warnings.warn(f"system=steering uses SIFT, because the weights {_STEERING_WEIGHTS} are not installed; with them it "
                  "is more precise, see `mfvpr weights list`", stacklevel=2)  # fmt: skip
    return "sift"


OmegaConf.register_new_resolver("aliked_or_sift", aliked_or_sift, replace=True)


def _set_up_jax(compiled: bool) -> None:
    """Keep compiled programs if `compiled`, and raise an InputError if JAX has no device, before any work."""
    import jax

    from mfvpr.utils.compiled_programs import VARIABLE, keep_compiled_programs

    os.environ[VARIABLE] = str(compiled).lower()  # which a map reads as well
    keep_compiled_programs(lambda line: tell(f"warning: {line}"))
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter for `cuda` without its plugin
        platforms = os.environ.get("JAX_PLATFORMS")
        setting = f"JAX_PLATFORMS={platforms}" if platforms else "JAX"
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise InputError(
            f"{setting}: expected a device that JAX can use here ({reason}); set JAX_PLATFORMS=cpu"
        ) from error
