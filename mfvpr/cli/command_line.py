"""Settings and systems by their names: Hydra composes `conf/` and overrides, a dataclass checks, a job gets them."""

import itertools
import json
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mfvpr.checkpoints import entry_of, is_installed
from mfvpr.cli import schema
from mfvpr.cli.console import explain, one_line, tell, warn
from mfvpr.datasets import image_folder
from mfvpr.datasets.ground_truth import CHOICES, likely_ground_truth
from mfvpr.evaluation import System
from mfvpr.io.containers import reading
from mfvpr.systems import assembly
from mfvpr.systems.assembly import CONF, without
from mfvpr.utils.cluster import Cluster
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import from_values
from mfvpr.utils.files import expand_user

Job = Callable[[Any], None]  # of the settings of its program
_FLAGS_WITH_VALUES = r"-c|--cfg|-p|--package|-i|--info|-c[pnd]|--config-(path|name|dir)|--experimental-rerun"
# Without any of these arguments, `system=auto` chooses.
_CHOICES = r"[~+]*(system|experiment|features|retrieval|matching|scorer)[=.@]|-h$|--help|--hydra-help|--info|--config"


def run(program: str, find_job: Callable[[], Job]) -> None:
    """Run the job of a program once, or with `--multirun` for each combination of values."""
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors
    warnings.filterwarnings("ignore", "A worker stopped")  # joblib renews a worker that has grown
    schema.register()
    typed = with_paths_as_settings(program, sys.argv[1:])
    if program in ("evaluate", "map") and not any(re.match(_CHOICES, each) for each in typed):
        at = next((place for place, each in enumerate(typed) if re.match("[^-].*=", each)), len(typed))
        typed.insert(at, "system=auto")  # beside the other settings, since Hydra takes one group of them
    is_auto = "system=auto" in typed
    sys.argv[1:] = itertools.chain.from_iterable(map(translate, typed))

    def task(composed: DictConfig) -> None:
        about, typed, multirun = HydraConfig.get(), sys.argv[1:], None
        if about.mode == RunMode.MULTIRUN:
            typed = [*about.overrides.task]
            overrides = dict(override.split("=", 1) for override in typed)
            multirun = {"multirun": about.sweep.dir, "number": about.job.num, "overrides": overrides}
            tell(f"job {about.job.num}: {' '.join(typed)}")
        with one_line() if multirun is None else nullcontext():  # in here, or Hydra adds lines to the error
            settings, job = checked(program, composed), find_job()
            if is_auto:
                tell(installed_system()[1])
            _set_up_jax(settings.compiled)
            if not isinstance(settings, schema.Common):
                job(settings)
                return
            shown = shlex.join(argument for argument in typed if not argument.startswith("launcher="))
            chosen = settings.cluster
            starts = {"address": Cluster.connect, "local": Cluster.local, "slurm": Cluster.slurm}
            with starts[chosen["name"]](**without(chosen, "name")) if chosen else nullcontext() as workers:
                if workers is not None:
                    tell(f"cluster: {workers}")
                job(replace(settings, command=f"mfvpr {program} {shown}", multirun=multirun, workers=workers))

    hydra.main(version_base="1.3", config_path=str(CONF), config_name=program)(task)()


def with_paths_as_settings(program: str, typed: list[str]) -> list[str]:
    """`mfvpr evaluate DATABASE QUERIES`, `map build MAP IMAGES` and `localize MAP IMAGES` as settings.

    With folders, the settings of the data set need no `dataset.`, and the ground truth is the likely one if none is
    typed.
    """
    is_path = lambda each: re.match(r"[./]|~/", each) or not re.match(r"[-~]|.*=", each)  # noqa: E731
    paths, settings = list[str](), list[str]()
    for before, each in itertools.pairwise(["", *typed]):
        (paths if is_path(each) and not re.fullmatch(_FLAGS_WITH_VALUES, before) else settings).append(each)
    if not paths:
        return typed
    usage = "DATABASE QUERIES" if program in ("evaluate", "sweep", "learn") else "MAP IMAGES"
    if len(paths) < 2 or (program == "map" and len(paths) > 2):
        raise InputError(f"{paths[0]}: expected {usage} and settings NAME=VALUE, got {' '.join(paths)}")
    first, *rest = paths
    listed = _quoted(rest[0]) if len(rest) == 1 else f"[{','.join(map(_quoted, rest))}]"
    if program == "localize":
        return [override("map", first), f"images={listed}", *settings]
    if any(each.startswith("dataset=") for each in settings):
        raise InputError(f"{first}: expected either folders or dataset=NAME, got both; leave one out")
    settings = [f"dataset.{each}" if each.partition("=")[0] in schema.FOLDER_SETTINGS else each for each in settings]
    database = first
    if program == "map":  # its data set has the same folder as queries, which are not read
        [database] = rest
        settings[:0] = [override("map", first), "dataset.ground_truth=none"]
    elif not any(each.startswith("dataset.ground_truth=") for each in settings):
        settings.insert(0, f"dataset.ground_truth={_likely_ground_truth(first, rest)}")
    return ["dataset=folder", override("dataset.database", database), f"dataset.queries={listed}", *settings]


def _likely_ground_truth(database: str, queries: list[str]) -> str:
    """The ground truth that the names of images suggest, for all folders of queries; an InputError if there is none."""
    names, *of_queries = (image_folder(expand_user(path)).names for path in (database, *queries))
    likely = [likely_ground_truth(each, names) for each in of_queries]
    kinds = {each and each[0] for each in likely}
    if len(kinds) > 1 or likely[-1] is None:
        got = f"{', '.join(map(str, map(len, of_queries)))} queries and {len(names)} database images of other names"
        raise InputError(f"ground_truth: expected one of {CHOICES}, since there are {got}")
    kind, reason = likely[-1]
    tell(f"ground_truth={kind}: {reason}; see mfvpr/datasets/README.md")
    return kind


def translate(override: str) -> list[str]:
    """`system=auto` and `retrieval=[A,B]` in Hydra's words, which would merge the choices of a list; others as is."""
    if override == "system=auto":
        return installed_system()[0]
    if (listed := re.fullmatch(r"retrieval=\[(.*)\]", override)) is None:
        return [override]
    names = [name.strip() for name in listed[1].split(",")]
    return ["~retrieval", *(f"+retrieval@retrieval.{name}={name}" for name in names)]


def installed_system() -> tuple[list[str], str]:
    """`system=auto`: the best recommended system whose weights are installed, or none; and a line that says which."""
    for system, network in (("mfvpr", "aliked-n16"), ("fast", "xfeat")):
        if all(is_installed(entry_of(name)) for name in (network, "efficientnet_lite0")):
            about = "whose weights are installed; choose another with system=NAME"
            return [f"system={system}"], f"system=auto: {system}, {about}"
    better = "better with weights: mfvpr weights download recommended"
    return ["features=sift"], f"system=auto: SIFT and VLAD, which need no weights; {better}"


def _set_up_jax(compiled: bool) -> None:
    """Keep compiled programs if `compiled`, and raise an InputError if JAX has no device, before any work."""
    import jax

    from mfvpr.utils.compiled_programs import VARIABLE, keep_compiled_programs

    os.environ[VARIABLE] = str(compiled).lower()  # which a map reads as well
    keep_compiled_programs(warn)
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter for `cuda` without its plugin
        platforms, reason = os.environ.get("JAX_PLATFORMS"), " ".join(str(error).splitlines()[:1])
        raise InputError(f"JAX_PLATFORMS={platforms}: expected a device of JAX, such as cpu, got: {reason}") from error


def checked(program: str, composed: DictConfig) -> Any:
    """Composed settings as the dataclass of the program, if they are allowed."""
    values: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    return from_values(schema.PROGRAMS[program], values)


def compose(program: str, overrides: list[str]) -> DictConfig:
    """The settings of a program with overrides in Hydra's grammar, also while Hydra runs."""
    schema.register()
    running = GlobalHydra.instance().is_initialized()
    try:
        with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra.compose(program, overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(explain(error)) from error


def compose_data_sets(data_sets: list[Any]) -> list[dict[str, Any]]:
    """The checked settings of data sets such as `streets` or `{corridor: {root: DIR}}`."""
    composed = []
    for each in data_sets:
        for name, values in ({each: {}} if isinstance(each, str) else each).items():
            config = compose("learn", [f"dataset={name}", *_overrides(values or {}, "dataset.")]).dataset
            if missing := sorted(OmegaConf.missing_keys(config)):
                raise InputError(f"{missing[0]}: expected a value of {name}")
            settings: Any = OmegaConf.to_container(config, resolve=True)
            schema.check_data_set(settings)
            composed.append(settings)
    return composed


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
    if not str(name).endswith(".json"):
        overrides = installed_system()[0] if name == "auto" else [override("system", name)]
        composed = compose("evaluate", [*overrides, *_overrides(settings)])
        values: Any = OmegaConf.to_container(composed, resolve=True)
        chosen = from_values(schema.Evaluate, values)
    elif settings:
        raise InputError(f"{name}: expected no other settings, got {', '.join(settings)}; load a system by name")
    else:
        with reading(Path(name), "the run.json of a run of mfvpr evaluate"):
            chosen = from_values(schema.Evaluate, json.loads(Path(name).read_text(encoding="utf-8"))["settings"])
    return assembly.system(chosen)


def override(name: str, value: Any) -> str:
    """An override of text in Hydra's grammar."""
    return f"{name}={_quoted(value)}"


def _quoted(value: Any) -> str:
    escaped = str(value).replace("'", "\\'").replace("${", "\\${")
    return f"'{escaped}'"


def _overrides(settings: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Settings in Hydra's grammar."""
    for name, value in settings.items():
        if f"{prefix}{name}" == "retrieval" and isinstance(value, list | tuple):
            yield from translate(f"retrieval=[{','.join(value)}]")
        elif f"{prefix}{name}" == "fusion.weights" and isinstance(value, Mapping):  # any names, no settings
            yield f"fusion.weights={{{','.join(f'{scorer}:{weight}' for scorer, weight in value.items())}}}"
        elif isinstance(value, Mapping):
            yield from _overrides(value, f"{prefix}{name}.")
        elif isinstance(value, str):
            yield override(f"{prefix}{name}", value)
        else:
            yield f"{prefix}{name}={json.dumps(value, ensure_ascii=False, default=_plain)}"


def _plain(value: Any) -> Any:
    """A number of NumPy as Python's, and a date that YAML read as its text."""
    return value.item() if isinstance(value, np.generic) else str(value)


def aliked_or_sift() -> str:
    """The features of system=steering: ALIKED if its weights are installed, otherwise SIFT, with a warning."""
    if is_installed(entry_of("aliked-n16")):
        return "aliked"
    warnings.warn("system=steering uses SIFT without ALIKED's weights: mfvpr weights download aliked-n16", stacklevel=2)
    return "sift"


OmegaConf.register_new_resolver("aliked_or_sift", aliked_or_sift, replace=True)
