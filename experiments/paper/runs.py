"""The evaluations, each in its run folder and not repeated; the seconds of a query, by step."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from experiments.paper.systems import Place, overrides
from mfvpr.checkpoints import REGISTRY, files
from mfvpr.cli import evaluation, jobs
from mfvpr.cli.command_line import checked, compose
from mfvpr.cli.jobs import Inputs
from mfvpr.cli.schema import Evaluate, Paper
from mfvpr.datasets import Dataset
from mfvpr.evaluation import System, rank_dataset
from mfvpr.features import PatchNetVladFeatures, SelaVprFeatures, SsmCells
from mfvpr.report.pages import PAGE
from mfvpr.report.run_files import ground_truth, write_run_folder
from mfvpr.report.runs import LAST, write_about, write_json, writing
from mfvpr.retrieval import fit_to_database
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user, lock_folder
from mfvpr.utils.fingerprints import fingerprint, versions
from mfvpr.utils.numerics import available_cpus

# See `input_fingerprints`, `bytes_of_an_image` and `measure_query`.
INPUTS, SIZES, SECONDS = "made_of.json", "sizes.json", "seconds.json"
_FLOAT, _KEYPOINT = 4, 12  # bytes of a number, and of a keypoint with its score
_GRIDS = (SsmCells, PatchNetVladFeatures, SelaVprFeatures)
QUERIES, DATABASE = 10, 60  # images; as many of the database as there are candidates, at least
STEPS = ("retrieval", "features", "matching", "scores")
_OUTPUTS = {"runs", "tables", "comparisons", PAGE}
_FREE = {"out", "cache", "memory", "devices", "compiled", "cluster"}  # settings that change no number


@contextmanager
def lock_output(out: Path) -> Iterator[None]:
    """Lock a folder for evaluations; an InputError if another process uses it, or if it has files of others."""
    out.mkdir(parents=True, exist_ok=True)
    in_use = f"out={out}: another process evaluates into it; wait until it ends, or name another folder"
    with lock_folder(out, InputError(in_use)):
        names = {path.name for path in out.iterdir() if not path.name.startswith(".")}
        if names and not {"runs"} <= names <= _OUTPUTS:  # files of an earlier output are removed
            raise InputError(f"out={out}: expected a new or empty folder, or one of this program; name another")
        yield


def settings_of(run: str, place: Place, settings: Paper) -> Evaluate:
    """The checked settings of an evaluation."""
    chosen = [*place.settings, *overrides(run, place.name), "figures=2"]
    changes = {name: getattr(settings, name) for name in ("cache", "memory", "devices")}
    changes |= {"out": str(folder_of(run, place.name, settings)), "command": f"mfvpr evaluate {' '.join(chosen)}"}
    return replace(checked("evaluate", compose("evaluate", chosen)), **changes)


def folder_of(run: str, dataset: str, settings: Paper) -> Path:
    """The run folder of an evaluation."""
    return expand_user(settings.out) / "runs" / dataset / run


def input_fingerprints(settings: Evaluate, images: Mapping[str, str], truth: str | None) -> dict[str, str]:
    """Fingerprints of the inputs of an evaluation: settings, images, truth, weights; and the version of the code."""
    fixed = {name: value for name, value in to_values(settings).items() if name not in _FREE}
    fixed["dataset"] = {name: value for name, value in settings.dataset.items() if name not in ("root", "cache")}
    fixed["dataset"] |= {name: None for name in ("database", "queries") if name in fixed["dataset"]}  # folders
    names = [group.get("weights") for group in (settings.features, settings.retrieval, settings.matching)]
    weights = {name: files.read_provenance(name)["sha256"] for name in names if name in REGISTRY}
    return {
        "settings": fingerprint(fixed),
        "images": fingerprint(dict(images)),
        "ground truth": truth or "none",
        "weights": fingerprint(weights),
        "version": versions()["mfvpr"],
    }


def is_finished_with(inputs: Mapping[str, str], folder: Path) -> bool:
    """Whether a run of these inputs is finished there; InputError for one of other inputs. A damaged run is not."""
    if read_json(folder / LAST) is None or read_json(folder / SIZES) is None:
        return False
    before = read_json(folder / INPUTS) or {}
    if differing := [name for name, value in inputs.items() if before.get(name) != value]:
        mend = "remove it, or name another folder with out=DIR"
        raise InputError(f"{folder}: a finished run of other {' and '.join(differing)} is there; {mend}")
    return True


def evaluate(settings: Evaluate, inputs: Mapping[str, str]) -> None:
    """Evaluate into the run folder, without a table in the terminal."""
    with jobs.claim(settings.out, settings.dataset["name"], is_exclusive=True) as folder:
        outcome = evaluation.evaluation_of(settings)
        with writing(folder) as new:
            write_run_folder(new, outcome.report, outcome.description)
            write_json(new / INPUTS, dict(inputs))
            write_json(new / SIZES, bytes_of_an_image(outcome.inputs))
            jobs.draw_figures(new, outcome.figures)  # before results.json, after which the run counts as finished
            write_about(new, to_values(settings), ground_truth(outcome.report, outcome.description), settings.command)
    jax.clear_caches()  # other data sets need other programs, and each program takes memory maps


def bytes_of_an_image(inputs: Inputs[Evaluate]) -> dict[str, float]:
    """Average bytes in float32 of what was already extracted: `local` features, and the `descriptor` of retrieval.

    They are counted as in the paper: with detected keypoints, without those of a grid.
    """
    cache, pipeline, database = inputs.cache, inputs.pipeline, inputs.dataset.database
    extractor: Any = fit_to_database(pipeline.extractor, database, cache)
    keypoint = 0 if isinstance(pipeline.extractor, _GRIDS) else _KEYPOINT
    local = 0.0
    for scale, counts in zip(extractor.scales, cache.counts(database, extractor), strict=True):
        known = counts[counts >= 0]  # retrieval other than VLAD needs the candidates' features alone
        local += (_FLOAT * scale.dimension + keypoint) * (float(known.mean()) if known.size else 0.0)
    describer: Any = fit_to_database(pipeline.retriever, database, cache)  # all of the paper's have one
    vectors = cache.vectors(database, describer.describer, database).values
    return {"local": local, "descriptor": _FLOAT * vectors.shape[1]}


def read_json(path: Path) -> Any:
    """The value of a JSON file; None for a missing or damaged file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def measure_query(settings: Evaluate, dataset: Dataset) -> dict[str, float]:
    """Measure the seconds of a query by step.

    A part of the database is enough: only the search among descriptors depends on its size. Queries are evaluated
    twice, as files of equal pixels and other bytes: the second pass, which is timed, extracts their features again,
    but compiles nothing, and extracts no feature of the database.
    """
    sequence, candidates = dataset.sequences[-1], settings.candidates  # RobotCar's snow, as the paper
    paths = sequence.images.paths[:QUERIES]
    least = DATABASE if candidates == "all" else max(DATABASE, candidates)
    database = replace(dataset.database, names=tuple(dataset.database.names[:least]))
    pipeline, scorers = assembly.pipeline(settings, None), assembly.scorers(settings.scorer)
    main, seconds = "histogram" if "histogram" in scorers else next(iter(scorers)), dict[str, float]()
    with tempfile.TemporaryDirectory(prefix="mfvpr-timing-") as folder:
        cache = FeatureCache(Path(folder) / "cache")
        system = System(pipeline, {main: scorers[main]})
        for turn in ("first", "second"):
            root = Path(folder) / turn
            root.mkdir()
            names = tuple(f"{turn}{row:04d}{path.suffix}" for row, path in enumerate(paths))
            for name, path in zip(names, paths, strict=True):
                (root / name).write_bytes(path.read_bytes() + turn.encode())  # readers ignore what follows an image
            images = replace(sequence.images, root=root, names=names)
            part = replace(sequence, images=images, truth=None, excluded=None)
            seconds = rank_dataset(Dataset(dataset.name, database, (part,)), system, cache=cache).seconds
    return {step: seconds.get(step, 0.0) / len(paths) for step in STEPS}


def device() -> dict[str, Any]:
    """The device that the seconds are measured on, and versions."""
    return {"device": jax.devices()[0].device_kind, "cores": available_cpus(), "versions": versions()}
