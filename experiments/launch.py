"""Runs a program under Hydra; what the user got wrong becomes one line and exit code 2."""

import difflib
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from experiments.errors import one_line, unwind_on_sigterm
from experiments.settings import SettingsError, check

PATHS = {"dataset.database", "dataset.queries", "dataset.root", "dataset.index_file", "dataset.cache"}
PATHS |= {"dataset.database_labels", "dataset.query_labels"}
PATHS |= {"store", "out", "checkpoints"}
MULTIRUN = ("-m", "--multirun")
CONF = Path(__file__).parent.parent / "conf"


def launch(program: Callable[[dict[str, Any]], None], config: str = "config") -> None:
    """`program(settings)` with the settings of conf/`config`.yaml and the command line, as plain and checked values."""

    def task(found: DictConfig) -> None:
        many = HydraConfig.get().mode == RunMode.MULTIRUN
        with _one_of_many() if many else one_line(), _our_words(config):  # in here, or Hydra adds lines of its own
            for name in sorted(OmegaConf.missing_keys(found)):
                raise SettingsError(_no_default(name))
            settings: Any = OmegaConf.to_container(found, resolve=True)
            check(settings)
            program(settings | {"multirun": many})

    unwind_on_sigterm()
    sys.unraisablehook = _keep_interrupt
    warnings.filterwarnings("ignore", "A worker stopped")  # joblib renews one that has grown; no job is lost
    if not os.environ.get("MFVPR_CACHE"):  # empty counts as unset, or the cache would be the root of the file system
        os.environ.pop("MFVPR_CACHE", None)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises instead of printing and exiting with 1
    with one_line(), _our_words(config):
        for argument in sys.argv[1:]:
            _check_form(argument)
        many = sorted({*MULTIRUN} & {*sys.argv})  # first, or Hydra takes no settings after it
        settings = [argument for argument in sys.argv[1:] if argument not in MULTIRUN]
        sys.argv[1:] = many[:1] + [_as_typed(argument, several=bool(many)) for argument in settings]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name=config)(task)()


def _keep_interrupt(lost: "sys.UnraisableHookArgs") -> None:
    """Send Ctrl-C again where nobody could catch it, as in JAX's callback of the garbage collector."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        main = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, [main, signal.SIGINT]).start()
    else:
        sys.__unraisablehook__(lost)


@contextmanager
def _one_of_many() -> Iterator[None]:
    """A job of a multirun: what is wrong with it is told at once, and again by Hydra when the others are done."""
    job = HydraConfig.get()
    chosen = [override for override in job.overrides.task if override.partition("=")[0] not in PATHS]
    print(f"job {job.job.num}: {' '.join(chosen)}", file=sys.stderr)
    try:
        with one_line():
            yield
    except SystemExit as left:
        if not isinstance(left.__context__, Exception) or left.code != 2:
            raise  # interrupted: no other job is begun
        raise left.__context__ from None


def _check_form(argument: str) -> None:
    """Refuse what is no setting, in words of our own rather than of Hydra's grammar."""
    name, equals, value = argument.partition("=")
    if argument.startswith(("+", "~")):
        raise SettingsError(f"{argument}: settings can be set, not added or removed; write name=value")
    if argument.startswith("-"):
        return
    if not equals:
        raise SettingsError(f"{argument}: expected name=value; put quotes around values with spaces")
    choices = sorted(path.stem for path in (CONF / name).glob("*.yaml")) if name.isidentifier() else []
    for choice in value.split(",") if choices else []:
        if choice not in choices:
            nearest = difflib.get_close_matches(choice, choices, n=1)
            hint = f"; the nearest is {nearest[0]}" if nearest else ""
            raise SettingsError(f"{argument}: expected one of {', '.join(choices)}{hint}")


def _as_typed(argument: str, several: bool) -> str:
    """A setting quoted for Hydra where its grammar would not take the value as it was typed (paths, mostly).

    Where `several`, in a multirun, paths stand between commas.
    """
    name, equals, value = argument.partition("=")
    is_path = name in PATHS and value not in ("", "null") and value[0] not in "'\""
    if not equals or argument.startswith("-") or not (is_path or _unparsable(argument)):
        return argument
    for special in ("\\", "'", "${"):
        value = value.replace(special, f"\\{special}")
    values = value.split(",") if several and is_path else [value]
    return f"{name}=" + ",".join(f"'{one}'" for one in values)


def _unparsable(argument: str) -> bool:
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return True
    return False


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
    unknown = re.search(r"Could not override '([^']*)'", text) or re.search(r"Key '([^']*)' is not in struct", text)
    if not unknown:
        return text
    wrong = unknown.group(1)
    nearest = max(_setting_names(config), key=lambda name: _likeness(wrong, name))
    alike = max(_likeness(wrong, nearest)) >= 0.6
    return f"{wrong}: unknown setting; " + (f"the nearest is {nearest}" if alike else "see --help")


def _no_default(name: str) -> str:
    return f"{name}: this setting has no default; give {name}=VALUE"


def _likeness(wrong: str, name: str) -> tuple[float, float]:
    """How alike two dotted names are: their last parts first, then all."""
    pairs = ((wrong.rpartition(".")[2], name.rpartition(".")[2]), (wrong, name))
    last, whole = (difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)
    return last, whole


def _setting_names(config: str) -> list[str]:
    """Every setting of the configuration that the command line's groups choose."""
    groups = [path.name for path in CONF.iterdir() if path.is_dir()]
    choices = [argument for argument in sys.argv[1:] if argument.partition("=")[0] in groups]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        names, pending = [], [("", hydra.compose(config, choices))]
    while pending:
        prefix, node = pending.pop()
        for name in node:
            names.append(f"{prefix}{name}")
            child = node._get_node(name)
            if isinstance(child, DictConfig) and not child._is_missing():
                pending.append((f"{prefix}{name}.", child))
    return names
