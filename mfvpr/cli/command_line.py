"""Turn the command line into checked settings with Hydra, and Hydra's errors into one line."""

import difflib
import gc
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mfvpr.cli.console import tell
from mfvpr.cli.groups import PROGRAMS, check_choice, choices, choices_with, groups
from mfvpr.cli.launch import import_job, on_interrupt, one_line
from mfvpr.cli.overrides import PATHS, compose_program, quote, register_resolvers, split_first
from mfvpr.cli.wording import in_settings
from mfvpr.systems.settings import CONF, REMOVED, SettingsError, check, nodes

_MULTIRUN = ("-m", "--multirun")
_NAME = r"[A-Za-z_][\w/@]*(?:\.\w+)*"  # of a setting, or of a group
_EXTRAS = {"joblib": "sweep", "submitit_local": "slurm", "submitit_slurm": "slurm"}  # install Hydra's launchers
_EXPLANATIONS = {  # by their patterns in errors of Hydra and OmegaConf
    r"Missing mandatory value: ([\w.]+)": r"\1: this setting has no default; give \1=VALUE",
    r"^(.*) full_key: ([\w.]+)": r"\2: \1",
    r"^Ambiguous value for argument '(.*?)' 1\.": r"\1: expected one value; write [...] for a list; to run once for "
    "each, add --multirun",
    r"^Error merging override (\S+)": r"\1: this is a group of settings; set one of its members (see --help)",
}
_RENAMED = {"store": "cache", "fusion.filter_score": "fusion.retrieval_score"}  # in version 0.3.0
_MAX_DIGITS = 300  # beyond float64, and Python does not parse thousands of digits


def run(config: str) -> None:
    """Run the job of a program once, or with `--multirun` for each combination of values."""

    def task(composed: DictConfig) -> None:
        hydra_settings = HydraConfig.get()
        is_multirun = hydra_settings.mode == RunMode.MULTIRUN
        # In here, or Hydra adds lines to the errors.
        with _multirun_job() if is_multirun else one_line(), hydra_errors(config, typed):
            for setting in sorted(OmegaConf.missing_keys(composed)):
                raise SettingsError(f"{setting}: this setting has no default; give {setting}=VALUE")
            settings: Any = OmegaConf.to_container(composed, resolve=True)
            check(settings)
            overrides = hydra_settings.overrides.task if is_multirun else typed
            arguments = [override for override in overrides if not override.startswith("launcher=")]
            command = f"{name} {shlex.join(arguments)}"
            job = import_job(job_path)
            from mfvpr.cli import build  # imported with the job

            _set_up_jax(settings.pop("compiled"))
            interruptible = on_interrupt(signal.default_int_handler)
            multirun_job = is_multirun and {
                "multirun": hydra_settings.sweep.dir, "number": hydra_settings.job.num,
                "overrides": dict(override.split("=", 1) for override in hydra_settings.overrides.task),
            }  # fmt: skip
            words, cluster = in_settings(settings), build.cluster(settings.get("cluster"))
            with interruptible, words, _frozen_imports(), cluster as started:
                job(settings | {"multirun": multirun_job, "command": command, "cluster": started})

    register_resolvers(partial(_note_once, set()))  # Hydra composes twice
    name, job_path = PROGRAMS[config]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of printing and exiting with 1
    typed = sys.argv[1:]
    with hydra_errors(config, typed):
        multirun = sorted({*_MULTIRUN} & {*typed})
        arguments = split_first(typed) if config == "learn" and not multirun else typed
        names = {argument.partition("=")[0] for argument in arguments}
        if "cluster.address" in names and "cluster" not in names:
            arguments = ["cluster=address", *arguments]
        for argument in arguments:
            _check_form(argument, config)
            if argument.startswith("launcher=") and not (multirun and "," not in argument):
                raise SettingsError(f"{argument}: expected one, and --multirun, which starts jobs with it")
        quoted = [quote(argument, several=bool(multirun)) for argument in arguments if argument not in _MULTIRUN]
        sys.argv[1:] = multirun[:1] + quoted  # Hydra takes no settings before --multirun
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=config)(task)()


def _note_once(lines: set[str], line: str) -> None:
    if line not in lines:
        lines.add(line)
        tell(f"note: {line}")


def _set_up_jax(compiled: bool) -> None:
    """Keep compiled programs if `compiled`, and raise a SettingsError if JAX has no device, before any work."""
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
        raise SettingsError(
            f"{setting}: expected a device that JAX can use here ({reason}); set JAX_PLATFORMS=cpu"
        ) from error


@contextmanager
def _frozen_imports() -> Iterator[None]:
    """Spare objects of imported modules from garbage collection: it took an eighth of a short job's time."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _multirun_job() -> Iterator[None]:
    """Announce a job of a multirun and print its error at once; Hydra repeats it when the other jobs are done."""
    job = HydraConfig.get()
    chosen = [override for override in job.overrides.task if override.partition("=")[0] not in PATHS]
    tell(f"job {job.job.num}: {' '.join(chosen)}")
    try:
        with one_line():
            yield
    except SystemExit as left:
        if not isinstance(left.__context__, Exception) or left.code != 2:
            raise  # interrupted: start no other job
        raise left.__context__ from None


def _check_form(argument: str, config: str) -> None:
    """Raise a SettingsError for an argument that is no setting."""
    name, equals, value = argument.partition("=")
    if argument.startswith(("+", "~")):
        raise SettingsError(f"{argument}: settings can be set, not added or removed; write name=value")
    if argument in _MULTIRUN:
        return
    if argument.startswith("-"):
        raise SettingsError(f"{argument}: unknown option; expected --help, --version, --multirun, or name=value")
    if not equals or not re.fullmatch(_NAME, name):
        raise SettingsError(f"{argument}: expected name=value; put quotes around values with spaces")
    if re.search(rf"\d{{{_MAX_DIGITS},}}", value):
        raise SettingsError(f"{name}={value[:20]}...: expected a number of fewer than {_MAX_DIGITS} digits")
    if choices(name):
        check_choice(name, value, config)


@contextmanager
def hydra_errors(config: str, arguments: Sequence[str]) -> Iterator[None]:
    """Raise Hydra's errors about the arguments of a program as SettingsErrors."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(_explain(error, config, arguments)) from error


def _explain(error: Exception, config: str, arguments: Sequence[str]) -> str:
    """Explain a Hydra error in one line; for an unknown setting, name the nearest one."""
    text = " ".join((str(error) or str(error.__cause__)).split())
    text = text.partition(" Config search path")[0].partition(" See https")[0]
    if launcher := re.search(r"Could not find 'hydra/launcher/(\w+)'.*: ([\w ]+)", text):
        mend = f"pip install 'mfvpr[{_EXTRAS[launcher[1]]}]'" if launcher[1] in _EXTRAS else f"there are {launcher[2]}"
        return f"{launcher[1]}: this launcher is not installed; {mend}"
    if unknown := re.search(r"Could not override '([^']*)'|Key '([^']*)' is not in struct", text):
        name = unknown[1] or unknown[2]
        return f"{name}: unknown setting; {_suggestion(name, config, arguments)}"
    for pattern, words in _EXPLANATIONS.items():
        if known := re.search(pattern, text):
            return known.expand(words)
    return text


def _suggestion(wrong: str, config: str, arguments: Sequence[str]) -> str:
    """Suggest a setting for an unknown one: in its group, in another choice of its group, or a similar name."""
    if wrong in _RENAMED:
        return f"its name is {_RENAMED[wrong]} now"
    if wrong.rpartition(".")[2] in REMOVED:
        return "it was removed in version 0.3.0"
    chosen = [argument for argument in arguments if argument.partition("=")[0] in groups(config)]
    settings: Any = OmegaConf.to_container(compose_program(config, chosen))
    values = dict(nodes(settings))
    group, (outer, _, name) = wrong.partition(".")[0], wrong.rpartition(".")
    if outer in values and not isinstance(values[outer], dict):
        return f"the nearest is {outer}, set as a whole"
    same_name = [known for known in values if known.rpartition(".")[2] == name]
    same_group = []
    if group in groups(config):
        same_group = [known for known in values if known.startswith(f"{group}.")]
        same_name = [known for known in same_name if known in same_group] or same_name
        choices = [f"{group}={choice}" for choice in choices_with(group, name)]
        if choices and not {*same_name} & {*same_group}:
            return f"{' and '.join(choices)} {'have' if len(choices) > 1 else 'has'} {group}.{name}"
    nearest = max(same_name or same_group or values, key=lambda known: _similarity(wrong, known))
    return f"the nearest is {nearest}" if max(_similarity(wrong, nearest)) >= 0.6 else "see --help"


def _similarity(wrong: str, name: str) -> tuple[float, float]:
    """Similarity of the last parts of two dotted names, and of the names."""
    last_parts = wrong.rpartition(".")[2], name.rpartition(".")[2]
    return difflib.SequenceMatcher(None, *last_parts).ratio(), difflib.SequenceMatcher(None, wrong, name).ratio()
