"""The evaluations, each in a run folder of its own; what is finished is not done again."""

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import hydra
import jax
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from experiments import evaluation, run_folder
from experiments.paper.sizes import bytes_of_an_image
from experiments.paper.systems import Place, overrides
from experiments.settings import CONF, SettingsError, check
from mfvpr.checkpoints import REGISTRY, files
from mfvpr.report import runs
from mfvpr.report.pages.one_run import PAGE
from mfvpr.utils.files import remove_leftovers
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.locks import lock_folder
from mfvpr.utils.versions import versions

FIGURES = 2  # queries that each run draws
_MADE_OF, _SIZES = "made_of.json", "sizes.json"
_SHARED = ("store", "memory", "devices")  # settings of both programs
_FREE = {"out", "store", "memory", "devices", "command"}  # of which no number depends


@contextmanager
def held(out: Path) -> Iterator[None]:
    """Keep others from evaluating into a folder, and remove what was being written there by one that was killed.

    Raises:
        SettingsError: another process does, or the folder cannot be made.
    """
    in_use = SettingsError(f"out={out}: another process evaluates into it; wait until it ends, or name another folder")
    with ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_folder(out, in_use))
        except OSError as error:
            raise SettingsError(f"out={out}: cannot be made ({error.strerror}); name another folder") from error
        remove_leftovers(out)
        yield


def settings_of(run: str, place: Place, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The checked settings of an evaluation."""
    chosen = [*place.settings, *overrides(run, place.name), f"figures={FIGURES}"]
    running = GlobalHydra.instance().is_initialized()
    with nullcontext() if running else hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        composed: Any = OmegaConf.to_container(hydra.compose("config", chosen), resolve=True)
    composed |= {name: settings[name] for name in _SHARED}
    composed["out"] = str(folder_of(run, place, settings))
    check(composed)
    return composed | {"command": f"python -m experiments.evaluate {' '.join(chosen)}"}


def folder_of(run: str, place: Place, settings: Mapping[str, Any]) -> Path:
    """Its run folder."""
    return Path(settings["out"]).expanduser() / "runs" / place.name / run


def made_of(settings: Mapping[str, Any], images: Mapping[str, str], truth: str | None) -> dict[str, str]:
    """What an evaluation follows from, each as a hash: settings, images, truth, weights, and the code's version."""
    free = {name: value for name, value in settings.items() if name not in _FREE}
    free["dataset"] = {name: value for name, value in settings["dataset"].items() if name not in ("root", "cache")}
    free["dataset"] |= {name: None for name in ("database", "queries") if name in free["dataset"]}  # folders
    names = [settings[group].get("weights") for group in ("features", "retrieval", "matching")]
    weights = {name: files.fingerprint(name) for name in names if name in REGISTRY}
    return {
        "settings": fingerprint(free), "images": fingerprint(dict(images)),
        "ground truth": truth or "none", "weights": fingerprint(weights),
        "version": versions()["mfvpr"],
    }  # fmt: skip


def is_finished(folder: Path) -> bool:
    """Whether a run is finished there, whatever it is of."""
    return (folder / "results.json").is_file()


def is_done(folder: Path, expected: Mapping[str, str]) -> bool:
    """Whether a run is finished there.

    Raises:
        SettingsError: one of other settings, images, weights or of another version is, or a damaged one.
    """
    if not is_finished(folder):
        return False
    for name in ("results.json", "run.json", _SIZES):
        try:
            json.loads((folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise SettingsError(f"{folder}/{name}: is damaged, or missing; remove the folder, and run this again, or "
                                "name another with out=DIR") from None  # fmt: skip
    try:
        found = json.loads((folder / _MADE_OF).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = {}
    other = [name for name, value in expected.items() if not isinstance(found, dict) or found.get(name) != value]
    if other:
        raise SettingsError(f"{folder}: a finished run of other {' and '.join(other)} is there; remove it, or name "
                            "another folder with out=DIR")  # fmt: skip
    return True


def evaluate(settings: Mapping[str, Any], made_of: Mapping[str, str]) -> None:
    """One evaluation into its run folder; its table goes to no terminal."""
    with run_folder.claimed(settings, own=True) as folder:
        outcome = evaluation.evaluated(dict(settings))

        def write(new: Path) -> None:
            evaluation.write(new, outcome)
            runs.write_json(new / _MADE_OF, dict(made_of))
            runs.write_json(new / _SIZES, bytes_of_an_image(outcome.tools, outcome.images.dataset.database))
            run_folder.draw(new, outcome.figures)  # before results.json is there, as nothing is done again behind it

        run_folder.keep(folder, settings, evaluation.ground_truth(outcome), write)
    jax.clear_caches()  # compiled programs of one data set are of no use to another, and each takes maps of memory


def sizes(folder: Path) -> dict[str, float]:
    """Of a finished run, see `bytes_of_an_image`."""
    return json.loads((folder / _SIZES).read_text(encoding="utf-8"))


def page(folder: Path) -> None:
    """The page of a finished run, unless it is there."""
    if not (folder / PAGE).is_file():
        run_folder.report_page(folder)


def results(folder: Path) -> list[dict[str, Any]]:
    """Rows of a finished run."""
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


def asked(folder: Path) -> int | str:
    """Candidates that a finished run's settings ask for."""
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))["settings"]["candidates"]


def origin(folder: Path) -> Any:
    """What a finished run follows from, see `made_of`."""
    return json.loads((folder / _MADE_OF).read_text(encoding="utf-8"))
