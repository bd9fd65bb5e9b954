"""The command line as checked settings, with Hydra; what it says of a mistake, in our words."""

import difflib
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from experiments import distributed_launch
from experiments.console import tell
from experiments.data_sets import first_of
from experiments.errors import on_interrupt, one_line
from experiments.groups import PROGRAMS, check_choice, choices_with, groups
from experiments.quoting import PATHS, as_typed
from experiments.settings import CONF, Program, SettingsError, check
from experiments.wording import in_settings

MULTIRUN = ("-m", "--multirun")
_NAME = r"[A-Za-z_][\w/@]*(?:\.\w+)*"  # of a setting, or of a group
_EXTRAS = {"joblib": "sweep", "submitit_local": "slurm", "submitit_slurm": "slurm"}  # that bring Hydra's launchers
MOST_DIGITS = 300  # more are no number of float64, and Python refuses to read thousands


def run(program: Program, config: str) -> None:
    """`program()(settings)`, once, or with `--multirun` for each combination of several values."""

    def task(found: DictConfig) -> None:
        job = HydraConfig.get()
        many = job.mode == RunMode.MULTIRUN
        with _one_of_many() if many else one_line(), _our_words(config):  # in here, or Hydra adds lines of its own
            for name in sorted(OmegaConf.missing_keys(found)):
                raise SettingsError(_no_default(name))
            settings: Any = OmegaConf.to_container(found, resolve=True)
            check(settings)
            own = [one for one in job.overrides.task if not one.startswith("launcher=")] if many else typed
            command = shlex.join(own)
            with distributed_launch.met(settings, PROGRAMS[config], own):
                work = program()
                _require_device()
                about = {"multirun": many, "command": f"python -m experiments.{PROGRAMS[config]} {command}"}
                with on_interrupt(signal.default_int_handler), in_settings(settings):
                    work(settings | about)

    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of printing and exiting with 1
    with _our_words(config):
        typed = sys.argv[1:]
        many = sorted({*MULTIRUN} & {*typed})  # first, or Hydra takes no settings after it
        arguments = first_of(typed) if config == "learn" and not many else typed
        for argument in arguments:
            _check_form(argument, config)
            if argument.startswith("launcher=") and not (many and "," not in argument):
                raise SettingsError(f"{argument}: expected one, and --multirun, which starts jobs with it")
        settings = [argument for argument in arguments if argument not in MULTIRUN]
        sys.argv[1:] = many[:1] + [as_typed(argument, several=bool(many)) for argument in settings]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=config)(task)()


def _require_device() -> None:
    """Refuse a device that JAX was asked for and does not have, before anything is begun."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter for `cuda` where there is no plugin
        asked = f"JAX_PLATFORMS={os.environ['JAX_PLATFORMS']}" if os.environ.get("JAX_PLATFORMS") else "JAX"
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise SettingsError(
            f"{asked}: expected a device that JAX can use here ({reason}); set JAX_PLATFORMS=cpu"
        ) from error


@contextmanager
def _one_of_many() -> Iterator[None]:
    """A job of a multirun: what is wrong with it is told at once, and again by Hydra when the others are done."""
    job = HydraConfig.get()
    chosen = [override for override in job.overrides.task if override.partition("=")[0] not in PATHS]
    tell(f"job {job.job.num}: {' '.join(chosen)}")
    try:
        with one_line():
            yield
    except SystemExit as left:
        if not isinstance(left.__context__, Exception) or left.code != 2:
            raise  # interrupted: no other job is begun
        raise left.__context__ from None


def _check_form(argument: str, config: str) -> None:
    """Refuse what is no setting, in words of our own rather than of Hydra's grammar."""
    name, equals, value = argument.partition("=")
    if argument.startswith(("+", "~")):
        raise SettingsError(f"{argument}: settings can be set, not added or removed; write name=value")
    if argument in MULTIRUN:
        return
    if argument.startswith("-"):
        raise SettingsError(f"{argument}: unknown option; expected --help, --version, --multirun, or name=value")
    if not equals or not re.fullmatch(_NAME, name):
        raise SettingsError(f"{argument}: expected name=value; put quotes around values with spaces")
    if re.search(rf"\d{{{MOST_DIGITS},}}", value):
        raise SettingsError(f"{name}={value[:20]}...: expected a number of fewer than {MOST_DIGITS} digits")
    check_choice(name, value, config)


@contextmanager
def _our_words(config: str) -> Iterator[None]:
    """Hydra's errors as ours."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(_explain(error, config)) from error


def _explain(error: Exception, config: str) -> str:
    """One line of a Hydra message, with the nearest setting where one is unknown."""
    text = " ".join((str(error) or str(error.__cause__)).split())
    text = text.partition(" Config search path")[0].partition(" See https")[0]
    if missing := re.search(r"Missing mandatory value: ([\w.]+)", text):
        return _no_default(missing[1])
    if launcher := re.search(r"Could not find 'hydra/launcher/(\w+)'.*: ([\w ]+)", text):
        mend = f"pip install 'mfvpr[{_EXTRAS[launcher[1]]}]'" if launcher[1] in _EXTRAS else f"there are {launcher[2]}"
        return f"{launcher[1]}: this launcher is not installed; {mend}"
    if unresolved := re.match(r"(.*) full_key: ([\w.]+)", text):
        return f"{unresolved[2]}: {unresolved[1]}"
    if several := re.match(r"Ambiguous value for argument '(.*?)' 1\.", text):
        return f"{several[1]}: expected one value; write [...] for a list; to run once for each, add --multirun"
    if group := re.match(r"Error merging override (\S+)", text):
        return f"{group[1]}: this is a group of settings; set one of its members (see --help)"
    unknown = re.search(r"Could not override '([^']*)'", text) or re.search(r"Key '([^']*)' is not in struct", text)
    if not unknown:
        return text
    return f"{unknown[1]}: unknown setting; {_meant(unknown[1], config)}"


def _meant(wrong: str, config: str) -> str:
    """What an unknown setting may be: one of its group, of another choice of its group, of the same name, or alike."""
    group, name, names = wrong.partition(".")[0], wrong.rpartition(".")[2], _setting_names(config)
    outer = wrong.rpartition(".")[0]
    if outer in names and not any(known.startswith(f"{outer}.") for known in names):  # null, or one value
        return f"the nearest is {outer}, set as a whole"
    own = [known for known in names if known.startswith(f"{group}.")] if group in groups(config) else []
    same = [known for known in names if known.rpartition(".")[2] == name]
    same_of_own = [known for known in same if known in own]
    others = [f"{group}={choice}" for choice in choices_with(group, name)] if group in groups(config) else []
    if others and not same_of_own:
        return f"{' and '.join(others)} {'have' if len(others) > 1 else 'has'} {group}.{name}"
    nearest = max(same_of_own or same or own or names, key=lambda known: _likeness(wrong, known))
    return f"the nearest is {nearest}" if max(_likeness(wrong, nearest)) >= 0.6 else "see --help"


def _no_default(name: str) -> str:
    return f"{name}: this setting has no default; give {name}=VALUE"


def _likeness(wrong: str, name: str) -> tuple[float, float]:
    """How alike two dotted names are: their last parts first, then all."""
    pairs = ((wrong.rpartition(".")[2], name.rpartition(".")[2]), (wrong, name))
    last, whole = (difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)
    return last, whole


def _setting_names(config: str) -> list[str]:
    """Every setting of the configuration that the command line's groups choose."""
    chosen = [argument for argument in sys.argv[1:] if argument.partition("=")[0] in groups(config)]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        names, pending = [], [("", hydra.compose(config, chosen))]
    while pending:
        prefix, node = pending.pop()
        for name in node:
            names.append(f"{prefix}{name}")
            child = node._get_node(name)
            if isinstance(child, DictConfig) and not child._is_missing():
                pending.append((f"{prefix}{name}.", child))
    return names
