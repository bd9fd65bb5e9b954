"""The inputs of a job from its settings: data set, pipeline, cache, runtime, and what counts as correct."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from mfvpr import datasets
from mfvpr.cli import console, notes
from mfvpr.cli.console import Progress, tell
from mfvpr.cli.schema import Common, RecallSettings
from mfvpr.core.types import Shortlist
from mfvpr.datasets import Dataset, IndexFile, LabelFiles
from mfvpr.datasets.contents import Contents, own_rows
from mfvpr.datasets.ground_truth import CHOICES
from mfvpr.datasets.published import published_dataset
from mfvpr.datasets.streets import CONDITIONS, TRUTH, streets_folder
from mfvpr.evaluation import EvaluationProtocol, Pipeline, evaluation_protocol, match_sequence
from mfvpr.evaluation.protocol import Split
from mfvpr.evaluation.sequence_matching import matches_recipe
from mfvpr.evaluation.system import folders_of
from mfvpr.matchers import MatchSet, Scales
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils import Runtime, Stopwatch
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user

Job = TypeVar("Job", bound=Common)
_FILES = ("index_file", "query_labels", "database_labels")
_WORDS = {
    "order": "file order",
    "utm": "positions in the names",
    "drawn": "drawn with the images",
    "published": "as published",
}


@dataclass(frozen=True)
class Inputs:
    """The inputs of a job."""

    dataset: Dataset  # without neighbors of the queries, if the settings exclude them
    contents: Mapping[str, Contents]  # of the image files, by side
    pipeline: Pipeline
    cache: FeatureCache
    ground_truth: dict[str, Any]  # kind, files, unit and thresholds, as results store them

    @property
    def thresholds(self) -> list[float]:
        """Thresholds of a correct prediction, ascending; empty without ground truth."""
        return self.ground_truth.get("thresholds", [])

    def protocol(self, split: Split | None) -> EvaluationProtocol:
        """The protocol of rankings for sweeps and learning."""
        if self.dataset.truth is None:
            raise InputError(
                "dataset.ground_truth=none: choosing settings needs a ground truth; set order, index, utm or label"
            )
        return evaluation_protocol(self.dataset.truth, self.thresholds, split)

    def match(self, watch: Stopwatch) -> tuple[MatchSet | Scales, Shortlist]:
        """Matches and shortlist of the only sequence, from their store if it has all of them."""
        result = match_sequence(self.dataset, self.dataset.only, self.pipeline, cache=self.cache, watch=watch)
        return result.by_scale, result.candidates

    def matches_recipe(self) -> dict[str, Any]:
        """Recipe of the shortlist and the matches of the only sequence, and of the fusion of several scales."""
        recipe = matches_recipe(self.dataset, self.dataset.only, self.pipeline, self.cache)
        scales = self.pipeline.scales
        return recipe | ({"scale_weights": [scale.weight for scale in scales]} if len(scales) > 1 else {})


def with_image_size(settings: Job) -> Job:
    """The settings with the image size that `features.image_size=auto`, or a number of pixels, leaves to the images."""
    if isinstance(settings.features["image_size"], list | None):
        return settings
    dataset = dataset_of(settings.dataset)
    pipeline = assembly.pipeline(settings, dataset)
    size = pipeline.size_for_images(folders_of(dataset), lambda line: tell(f"warning: {line}"))
    return replace(settings, features={**settings.features, "image_size": [*size]})


def prepare(settings: Common, watch: Stopwatch) -> Inputs:
    """The inputs that the settings name; notes and warnings tell what is peculiar about them.

    The pipeline comes first, since its errors should come before anything slow, unless it needs files about the images.
    """
    cache = cache_of(settings)
    names = {settings.features["name"], settings.retrieval["name"], settings.matching["name"]}
    pipeline = None if names & {"import", "pairs"} else assembly.pipeline(settings, None)
    with watch("data"):
        dataset, contents = _data(settings.dataset, cache)
        ground_truth = describe_truth(settings.dataset, settings.recall, dataset)
        notes.tell_peculiarities(dataset, contents, ground_truth.get("thresholds", []))
        if settings.retrieval["name"] != "pairs":  # whose numbers of candidates are not known yet
            notes.note_candidates(settings.candidates, settings.recall.ks, dataset.database)
        notes.warn_of_matching(settings, dataset.name, contents)
    return Inputs(dataset, contents, pipeline or assembly.pipeline(settings, dataset), cache, ground_truth)


def _data(settings: Mapping[str, Any], cache: FeatureCache) -> tuple[Dataset, dict[str, Contents]]:
    """The data set, without neighbors of the queries, and the contents of its files by side."""
    dataset, neighbors = dataset_of(settings), settings.get("exclude_neighbors")
    sides, sequences = {"database": cache.recipes.contents(dataset.database)}, []
    for sequence in dataset.sequences:
        contents = cache.recipes.contents(sequence.images)
        sides[f"query {sequence.name}" if len(dataset.sequences) > 1 else "query"] = contents
        if neighbors is not None:
            same_images = own_rows(contents, sides["database"])
            sequence = sequence.without_neighbors(len(dataset.database), same_images, neighbors)
        sequences.append(sequence)
    return replace(dataset, sequences=tuple(sequences)), sides


def cache_of(settings: Common) -> FeatureCache:
    """The cache of features, matches and all else that is computed from images, with the runtime of the job."""
    import jax

    number, devices = settings.devices, jax.local_devices()
    if isinstance(number, int) and number > len(devices):
        raise InputError(f"devices={number}: expected at most {len(devices)}, as many as there are here, or all")
    devices = devices[:number] if isinstance(number, int) else devices
    runtime = Runtime(devices, settings.memory, console.track, console.tell, settings.workers)
    root = None if settings.cache is None else expand_user(settings.cache)
    return FeatureCache(root, skip_bad=settings.on_bad_image == "skip", runtime=runtime)


def dataset_of(settings: Mapping[str, Any]) -> Dataset:
    """The data set; the synthetic street is drawn first if the cache does not have it."""
    if "cache" in settings:
        seasons, root = settings["name"] == "streets_seasons", expand_user(settings["cache"])
        with Progress("drawing streets", 0) as progress:
            root = streets_folder(root, seasons=seasons, seed=settings["seed"], progress=progress.reach)
        queries = [root / name for name in CONDITIONS] if seasons else root / "queries"
        truth = IndexFile(TRUTH if seasons else root / TRUTH, is_widened=True)
        return datasets.folder(root / "database", queries, ground_truth=truth, name=settings["name"])
    if "ground_truth" not in settings:
        seasons = settings.get("seasons")
        return published_dataset(settings["name"], expand_user(settings["root"]), seasons=seasons and tuple(seasons))
    if settings["ground_truth"] is None:
        raise InputError(f"dataset.ground_truth: nothing is assumed of your own images; set it to one of {CHOICES}")
    database, queries, several = settings["database"], settings["queries"], isinstance(settings["queries"], list)
    if several == ("database_labels" in settings):  # only a single sequence has labels
        expected = "DIR, or [DIR,...] with dataset=sequences" if several else "[DIR,...], or DIR with dataset=folder"
        raise InputError(f"dataset.queries: expected {expected}, got {queries}")
    queries = [expand_user(path) for path in queries] if several else expand_user(queries)
    options = {name: settings[name] for name in ("name", "orient", "bits")}
    return datasets.folder(expand_user(database), queries, ground_truth=_ground_truth(settings), **options)


def _ground_truth(settings: Mapping[str, Any]) -> IndexFile | LabelFiles | str:
    """The ground truth of folders of images, whose files must be those that it needs."""
    kind, paths = settings["ground_truth"], {}
    for option, reader in zip(_FILES, ("index", "label", "label"), strict=True):
        path = settings.get(option)
        if (path is not None) != (kind == reader):
            expected = f"dataset.{option}=FILE" if kind == reader else f"none, or dataset.ground_truth={reader}"
            raise InputError(f"dataset.ground_truth={kind}: expected {expected}, got dataset.{option}={path}")
        paths[option] = path and expand_user(path)
    if kind == "index":
        return IndexFile(paths["index_file"], settings["widen_index"])
    if kind == "label":
        return LabelFiles(paths["query_labels"], paths["database_labels"])
    return kind


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
    first, sources = descriptions[0], []
    if "unit" not in first:
        return "no ground truth: rankings only"
    for each in descriptions:
        files = ", ".join(dict.fromkeys(each["files"]))
        labels = "labels in " if each["kind"] == "label" else ""
        sources.append(labels + (files or _WORDS.get(each["kind"], each["kind"])))
    source = ", ".join(dict.fromkeys(sources))
    if first["unit"] == "exact":
        return f"recall in %, ground truth: {source}"
    within = ", ".join(f"{threshold:g}" for threshold in first["thresholds"])
    return f"recall in %, within {within} {first['unit']} of the ground truth: {source}"
