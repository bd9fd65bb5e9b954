"""Steps that jobs share: inputs from settings, warnings about them, and the run folder."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Generic, TypeVar

from mfvpr import datasets
from mfvpr.baselines.learned_weight import provenance
from mfvpr.cli.console import tell, track, warn
from mfvpr.cli.schema import Common, RecallSettings
from mfvpr.core.types import Shortlist
from mfvpr.datasets import Dataset, FrameTruth, IndexFile, LabelFiles
from mfvpr.datasets.contents import Contents, fingerprints, identical_rows
from mfvpr.datasets.ground_truth import CHOICES, threshold_words
from mfvpr.datasets.published import published_dataset, published_differences
from mfvpr.datasets.streets import CONDITIONS, TRUTH, streets_folder
from mfvpr.evaluation import EvaluationProtocol, Pipeline, evaluation_protocol, match_sequence
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.protocol import Split
from mfvpr.evaluation.system import folders_of
from mfvpr.matchers import MatchSet, Scales
from mfvpr.report import runs
from mfvpr.report.run_files import matched_content
from mfvpr.report.runs import Figure
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils import Runtime, Stopwatch
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user

Job = TypeVar("Job", bound=Common)
_FILES = {"index_file": "index", "query_labels": "label", "database_labels": "label"}  # and the ground truth in them


@dataclass(frozen=True)
class Inputs(Generic[Job]):
    """The inputs of a job."""

    settings: Job  # with the image size that `features.image_size=auto` leaves to the images
    dataset: Dataset  # without neighbors of the queries, if the settings exclude them
    contents: Mapping[str, Contents]  # of the image files, by side
    pipeline: Pipeline
    cache: FeatureCache  # with the watch of the job
    ground_truth: dict[str, Any]  # kind, files, unit and thresholds, as results store them

    @property
    def thresholds(self) -> list[float]:
        """Thresholds of a correct prediction, ascending; empty without ground truth."""
        return self.ground_truth.get("thresholds", [])

    @property
    def about(self) -> dict[str, Any]:
        """The data set in results."""
        seen = fingerprints(self.contents)
        return {"dataset": self.dataset.name, "data_fingerprint": seen, "ground_truth": self.ground_truth}

    def protocol(self, split: Split | None) -> EvaluationProtocol:
        """The protocol of rankings for sweeps and learning."""
        if self.dataset.truth is None:
            raise InputError("dataset.ground_truth=none: choosing settings needs order, index, utm or label")
        return evaluation_protocol(self.dataset.truth, self.thresholds, split)

    def match(self) -> tuple[MatchSet | Scales, Shortlist]:
        """Matches and shortlist of the only sequence, from their store if it has all of them."""
        result = match_sequence(self.dataset, self.dataset.only, self.pipeline, cache=self.cache)
        return result.by_scale, result.candidates


def prepare(settings: Job, watch: Stopwatch) -> Inputs[Job]:
    """The inputs that the settings name; notes and warnings tell what is peculiar about them.

    The pipeline comes first, since its errors should come before anything slow, unless it needs files about the images.
    """
    cache = replace(cache_of(settings), watch=watch)
    names = {settings.features["name"], *assembly.by_choice("retrieval", settings.retrieval), settings.matching["name"]}
    pipeline = None if names & {"import", "pairs"} else assembly.pipeline(settings, None)
    with watch("data"):
        dataset, neighbors = dataset_of(settings.dataset), settings.dataset.get("exclude_neighbors")
        pipeline = pipeline or assembly.pipeline(settings, dataset)
        if pipeline.pixels is not None:
            size = pipeline.size_for_images(folders_of(dataset), warn)
            pipeline = pipeline.with_image_size(size)
            settings = replace(settings, features={**settings.features, "image_size": [*size]})
        contents, sequences = {"database": cache.recipes.contents(dataset.database)}, []
        for sequence in dataset.sequences:
            side = f"query {sequence.name}" if len(dataset.sequences) > 1 else "query"
            contents[side] = cache.recipes.contents(sequence.images)
            if neighbors is not None:
                same_images = identical_rows(contents[side], contents["database"])
                sequence = sequence.without_neighbors(len(dataset.database), same_images, neighbors)
            sequences.append(sequence)
        dataset = replace(dataset, sequences=tuple(sequences))
        ground_truth = describe_truth(settings.dataset, settings.recall, dataset)
        _warn_of_data(dataset, contents, ground_truth.get("thresholds", []))
        _warn_of_settings(settings, dataset, contents)
    return Inputs(settings, dataset, contents, pipeline, cache, ground_truth)


def cache_of(settings: Common) -> FeatureCache:
    """The cache of features, matches and all else that is computed from images, with the runtime of the job."""
    import jax

    number, devices = settings.devices, jax.local_devices()
    if isinstance(number, int) and number > len(devices):
        raise InputError(f"devices={number}: expected at most {len(devices)}, as many as there are here, or all")
    devices = devices[:number] if isinstance(number, int) else devices
    runtime = Runtime(devices, settings.memory, track, tell, settings.workers)
    root = None if settings.cache is None else expand_user(settings.cache)
    return FeatureCache(root, skip_bad=settings.on_bad_image == "skip", runtime=runtime)


def dataset_of(settings: Mapping[str, Any]) -> Dataset:
    """The data set; the synthetic street is drawn first if the cache does not have it."""
    if "cache" in settings:
        seasons, root = settings["name"] == "streets_seasons", expand_user(settings["cache"])
        root = streets_folder(root, seasons=seasons, seed=settings["seed"], progress=track("drawing streets"))
        queries = [root / name for name in CONDITIONS] if seasons else root / "queries"
        truth = IndexFile(TRUTH if seasons else root / TRUTH, is_widened=True)
        return datasets.folder(root / "database", queries, ground_truth=truth, name=settings["name"])
    if "ground_truth" not in settings:
        seasons = settings.get("seasons")
        return published_dataset(settings["name"], expand_user(settings["root"]), seasons=seasons and tuple(seasons))
    kind, several = settings["ground_truth"], isinstance(settings["queries"], list)
    if kind is None:
        raise InputError(f"dataset.ground_truth: nothing is assumed of your own images; set it to one of {CHOICES}")
    for name, reader in _FILES.items():
        if (settings.get(name) is not None) != (kind == reader):
            expected = f"dataset.{name}=FILE" if kind == reader else f"no dataset.{name}, which is for {reader}"
            raise InputError(f"dataset.ground_truth={kind}: expected {expected}")
    if several and kind == "label":  # names of several folders may be the same
        raise InputError(f"dataset.ground_truth=label: expected one folder of queries, got {settings['queries']}")
    truth = kind
    if kind == "index":
        truth = IndexFile(expand_user(settings["index_file"]), settings["widen_index"])
    elif kind == "label":
        truth = LabelFiles(expand_user(settings["query_labels"]), expand_user(settings["database_labels"]))
    paths = [expand_user(path) for path in settings["queries"]] if several else expand_user(settings["queries"])
    options = {name: settings[name] for name in ("name", "orient", "bits")}
    options |= {name: expand_user(settings[name]) for name in ("masks", "among") if settings.get(name)}
    return datasets.folder(expand_user(settings["database"]), paths, ground_truth=truth, **options)


def describe_truth(choice: Mapping[str, Any], recall: RecallSettings, dataset: Dataset) -> dict[str, Any]:
    """Kind, files, unit and thresholds of the ground truth of a data set with the settings `choice`, for results."""
    truth = dataset.sequences[0].truth
    entries = {
        "kind": choice.get("ground_truth", "drawn" if "cache" in choice else "published"),
        "files": [choice[name] for name in _FILES if choice.get(name)],
        "exclude_neighbors": choice.get("exclude_neighbors"),
    }
    if truth is None:
        return entries
    thresholds = truth.thresholds(tolerances=recall.tolerances, radius=recall.radius)
    return entries | {"unit": truth.unit, "thresholds": thresholds}


def truth_in_words(*descriptions: Mapping[str, Any]) -> str:
    """The ground truth in a heading, from descriptions of data sets with the same thresholds."""
    if "unit" not in (first := descriptions[0]):
        return "no ground truth: rankings only"
    within = ", ".join(f"{threshold:g}" for threshold in first["thresholds"])
    within = "" if first["unit"] == "exact" else f" within {within} {first['unit']}"
    sources = [" ".join([each["kind"], *each["files"]]) for each in descriptions]
    return f"recall in %{within}, ground truth: {', '.join(dict.fromkeys(sources))}"


def score_in_words(settings: Common) -> str:
    """The score, and what its matches are of, in a heading."""
    return f"{settings.scorer['method']} score, {matched_content(vars(settings))}"


# --- notes and warnings ------------------------------------------------------------------------------------------


def _warn_of_data(dataset: Dataset, contents: Mapping[str, Contents], thresholds: Sequence[float]) -> None:
    """Warn of what is peculiar about the images and the ground truth, such as queries that are database images."""
    for difference in published_differences(dataset):
        warn(f"{dataset.name}: {difference}; its numbers are not comparable")
    for sequence, images in zip(dataset.sequences, [*contents.values()][1:], strict=True):
        same = FrameTruth(identical_rows(images, contents["database"]), len(dataset.database)).positives(0)
        if same := ((same if sequence.excluded is None else same - sequence.excluded).counts > 0).sum():
            images_of = f"{same} of {len(sequence.images)} queries are database images"
            warn(f"{images_of}: each finds itself; set dataset.exclude_neighbors=N, the frames to leave out around it")
        if (truth := sequence.truth) is None:
            continue
        without = [threshold for threshold in thresholds if not truth.positives(threshold).rows.size]
        if without == thresholds:
            warn("the ground truth has no correct image for any query; every recall will be 0")
        elif without:
            words = ", ".join(threshold_words(truth.unit, threshold).strip() for threshold in without)
            warn(f"no query has a correct image within {words}; recall will be 0 there; use larger recall.tolerances")
    largest = max(file.largest for images in contents.values() for file in images.files)
    used, bits = max(largest.bit_length(), 8), dataset.database.bits
    if largest and bits is not None and not bits - 1 <= used <= bits:
        look = "dark" if used < bits else "cut off"
        warn(f"the largest value of all 16-bit images is {largest}: they look {look}; use dataset.bits={used}")


def _warn_of_settings(settings: Common, dataset: Dataset, contents: Mapping[str, Contents]) -> None:
    """Warn of fewer candidates than expected, of features that LightGlue may not know, of weights that do not fit."""
    features, matching = settings.features, settings.matching
    if "pairs" not in assembly.by_choice(
        "retrieval", settings.retrieval
    ):  # whose numbers of candidates are not known yet
        available, number = num_candidates(settings.candidates, dataset.database), settings.candidates
        if isinstance(number, int) and number > available:
            tell(f"note: candidates={number}, but the database has {available} images; all of them are re-ranked")
        if deeper := [f"R@{k}" for k in settings.recall.ks if k > available]:
            tell(f"note: {', '.join(deeper)} = R@{available}, of retrieval too: no more candidates are looked at")
    if features["name"] == "import" and matching["name"] == "lightglue":
        warn("matching=lightglue knows ALIKED's features alone; what features=import gives must be these")
    names = {values.get("weight", "fs") for values in assembly.expand_weights(settings.scorer).values()}
    names |= {*(getattr(settings, "grid", {}).get("weight") or ())}  # that a sweep tries
    for name in sorted(names):
        if not (origin := provenance(name)):
            continue
        learned_on = [each.get("data_fingerprint", {}).values() for each in origin.get("data_sets", [origin])]
        if {*fingerprints(contents).values()} & {folder for folders in learned_on for folder in folders}:
            warn(f"weight={name} was learned on images of {dataset.name}, so that it flatters here")
        for group, key in (("features", "weights"), ("matching", "cross_check")):
            before, now = origin.get("settings", {}).get(group, {}), getattr(settings, group)
            if differing := [each for each in ("name", key) if before.get(each) != now.get(each)]:
                words = ", ".join(f"{before.get(each, 'unknown')} instead of {now.get(each)}" for each in differing)
                warn(f"weight={name} was learned with other {group} ({words}); it may mean nothing here")


# --- the run folder ----------------------------------------------------------------------------------------------


def claim(out: str | None, dataset: str, *, is_exclusive: bool = False) -> AbstractContextManager[Path]:
    """The run folder `out`, for this run alone, see `claim_run_folder`; None = a new one of a data set."""
    folder = expand_user(out) if out else Path("runs", dataset, f"{datetime.now():%Y-%m-%d_%H-%M-%S}")
    return runs.claim_run_folder(folder, numbered=not out, is_exclusive=is_exclusive)


def write_results(
    folder: Path,
    settings: Common,
    ground_truth: Mapping[str, Any],
    *,
    text: str,
    write: Callable[[Path], None],
    figures: Sequence[Figure],
) -> None:
    """Write the files, then print the text, then draw the figures, so that no failure loses earlier results.

    The text is printed even if the files cannot be written; `write` gets the folder for them.
    """
    try:
        with runs.writing(folder) as new:
            write(new)
            runs.write_about(new, to_values(settings), ground_truth, settings.command)
    finally:
        print(f"\n{text}", flush=True)
    draw_figures(folder, figures)
    print(f"results: {folder}")
    if job := settings.multirun:
        runs.add_job(Path(job["multirun"]), job["number"], job["overrides"], folder)
        print(f"jobs: {job['multirun']}")


def draw_figures(folder: Path, figures: Sequence[Figure]) -> None:
    """Draw the figures of a run; warn if one cannot be drawn."""
    for name, draw_figure in track("figures")(figures, len(figures)):
        try:
            draw_figure(folder / "figures" / name)
        except Exception as error:  # of any kind from Matplotlib; the results are already written
            warn(f"{folder}/figures/{name}: not drawn ({error})")
