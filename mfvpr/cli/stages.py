"""The first stages of every program: images -> features -> shortlist and matches."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

from mfvpr.cli import build, truth
from mfvpr.cli.console import Progress, tell
from mfvpr.datasets import Dataset, QuerySequence
from mfvpr.datasets.contents import Contents, OwnRows, own_rows
from mfvpr.datasets.published import published_differences
from mfvpr.datasets.truth import threshold_words
from mfvpr.evaluation import Pipeline, match_sequence
from mfvpr.evaluation.sequence_matching import matches_recipe, num_candidates
from mfvpr.matching import MatchSet, Scales
from mfvpr.scoring.weight_registry import provenance
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.types import Shortlist
from mfvpr.utils import Stopwatch

# A learned match weight depends on these settings.
_LEARNED_WITH = {"features": ("name", "weights"), "matching": ("name", "cross_check")}


@dataclass(frozen=True)
class Images:
    """A data set with the contents of its files."""

    dataset: Dataset
    contents: Mapping[str, Contents]  # by side

    @property
    def fingerprints(self) -> dict[str, str]:
        """Fingerprints of all folders, by side."""
        return {side: contents.fingerprint for side, contents in self.contents.items()}

    @property
    def reading(self) -> dict[str, Any]:
        """Conversions of the images when they are read, by side."""
        return {side: contents.summary() for side, contents in self.contents.items()}


@dataclass(frozen=True)
class Tools:
    """A pipeline, and the cache of its results."""

    pipeline: Pipeline
    cache: FeatureCache


def prepare(settings: dict[str, Any], watch: Stopwatch) -> tuple[Tools, Images]:
    """The tools and the data set that the settings name.

    The tools come first, since their errors should come before anything slow, unless they need files about the images.
    """
    cache = build.cache(settings)
    names = {settings[group]["name"] for group in ("features", "retrieval")}
    tools = None if names & {"import", "pairs"} else _tools(settings, cache, None)
    with watch("data"):
        images = _images(settings, cache)
    return tools or _tools(settings, cache, images.dataset), images


def _tools(settings: dict[str, Any], cache: FeatureCache, dataset: Dataset | None) -> Tools:
    return Tools(assembly.pipeline(settings, dataset), cache)


def _images(settings: dict[str, Any], cache: FeatureCache) -> Images:
    """The data set that the settings name, without neighbors of the queries; warns about its peculiarities."""
    dataset, neighbors = dataset_of(settings["dataset"]), settings["dataset"].get("exclude_neighbors")
    sides = {"database": cache.recipes.contents(dataset.database)}
    sequences, same_images = [], []
    for sequence in dataset.sequences:
        contents = cache.recipes.contents(sequence.images)
        sides[f"query {sequence.name}" if len(dataset.sequences) > 1 else "query"] = contents
        same_images.append(own_rows(contents, sides["database"]))
        if neighbors is not None:
            sequence = sequence.without_neighbors(len(dataset.database), same_images[-1], neighbors)
        sequences.append(sequence)
    images = Images(replace(dataset, sequences=tuple(sequences)), sides)
    for difference in published_differences(images.dataset):
        tell(f"warning: {dataset.name}: {difference}; its numbers are not comparable")
    for sequence, rows in zip(sequences, same_images, strict=True):
        _warn_of_sequence(settings, sequence, rows)
    _warn_of_reading(images)
    if settings["features"]["name"] == "import" and settings["matching"]["name"] == "lightglue":
        tell("warning: matching=lightglue knows ALIKED's features alone; what features=import gives must be these")
    _note_candidates(settings, num_candidates(settings["candidates"], dataset.database))
    _warn_of_weights(settings, images)
    return images


def match_data_set(tools: Tools, images: Images, watch: Stopwatch) -> tuple[MatchSet | Scales, Shortlist]:
    """Matches and shortlist of the only sequence, from their store if it has all of them."""
    result = match_sequence(images.dataset, images.dataset.only, tools.pipeline, cache=tools.cache, watch=watch)
    return result.by_scale, result.candidates


def recipe(tools: Tools, images: Images) -> dict[str, Any]:
    """Recipe of the shortlist and the matches of the only sequence, and of the fusion of several scales."""
    recipe = matches_recipe(images.dataset, images.dataset.only, tools.pipeline, tools.cache)
    scales = tools.pipeline.extractor.scales
    return recipe | ({"scale_weights": [scale.weight for scale in scales]} if len(scales) > 1 else {})


def dataset_of(settings: dict[str, Any]) -> Dataset:
    """The data set, with a progress bar if it must be drawn."""
    with Progress("drawing streets", 0) as progress:
        return build.dataset(settings, progress.reach)


def _warn_of_reading(images: Images) -> None:
    """Note conversions of the images, and warn of 16-bit images whose range does not fit."""
    for side, reading in images.reading.items():
        if reading["turned"]:
            tell(f"note: {reading['turned']} {side} images are turned as their EXIF orientation says")
        if reading["scaled_16bit"]:
            tell(f"note: {reading['scaled_16bit']} 16-bit {side} images are scaled to 8 bits")
    bits = images.dataset.database.bits
    largest = max(reading["largest_16bit"] or 0 for reading in images.reading.values())
    used = max(largest.bit_length(), 8)
    if largest and bits is not None and not bits - 1 <= used <= bits:
        look = "dark" if used < bits else "cut off"
        tell(f"warning: the largest value of all 16-bit images is {largest}, so that they come out {look}; "
              f"dataset.bits={used} would use their range")  # fmt: skip


def _note_candidates(settings: dict[str, Any], available: int) -> None:
    """Note that fewer candidates are available than `candidates` or `recall.ks` expect."""
    candidates = settings["candidates"]
    if candidates != "all" and candidates > available:
        tell(f"note: candidates={candidates}, but the database has {available} images; all of them are re-ranked")
    deeper = [f"R@{k}" for k in settings["recall"]["ks"] if k > available]
    if deeper:
        verb = "is" if len(deeper) == 1 else "are"
        tell(f"note: {' and '.join(deeper)} {verb} R@{available}, of retrieval too: no more candidates are looked at")


def _warn_of_weights(settings: dict[str, Any], images: Images) -> None:
    """Warn of a match weight that was learned on these images, or with other features or matches."""
    names = {values.get("weight", "fs") for values in assembly.by_scorer(settings["scorer"]).values()}
    for name in sorted(names | {*((settings.get("grid") or {}).get("weight") or ())}):
        origin = provenance(name)
        data_sets = origin["data_sets"] if isinstance(origin.get("data_sets"), list) else [origin]
        seen = {str(folder) for data_set in data_sets for folder in _mapping(data_set, "data_fingerprint").values()}
        if seen & {*images.fingerprints.values()}:
            tell(f"warning: weight={name} was learned on images of {images.dataset.name}, so that it flatters here")
        for group, keys in _LEARNED_WITH.items() if origin else ():
            before, now = _mapping(_mapping(origin, "settings"), group), settings[group]
            if other := [key for key in keys if before.get(key) != now.get(key)]:
                words = ", ".join(f"{before.get(key, 'unknown')} instead of {now.get(key)}" for key in other)
                tell(f"warning: weight={name} was learned with other {group} ({words}); it may mean nothing here")


def _mapping(content: Any, name: str) -> Mapping[str, Any]:
    """The mapping under a name in a file's content, which may be anything; empty if there is none."""
    entry = content.get(name) if isinstance(content, Mapping) else None
    return entry if isinstance(entry, Mapping) else {}


def _warn_of_sequence(settings: dict[str, Any], sequence: QuerySequence, same_images: OwnRows) -> None:
    """Warn of queries that are database images, and of thresholds without any correct prediction."""
    queries, same, excluded = len(same_images), sum(map(bool, same_images)), sequence.excluded
    if same and excluded is None:
        tell(f"warning: {same} of {queries} queries are database images themselves, so that each finds itself; set "
              "dataset.exclude_neighbors=N to leave out what is within N frames of it (0 = itself alone)")  # fmt: skip
    if excluded is not None and same < queries:
        tell(f"note: {queries - same} of {queries} queries are no database images; nothing is left out for them")
    ground_truth, thresholds = sequence.truth, truth.thresholds(settings, sequence.truth)
    if ground_truth is None:
        return
    without = list(takewhile(lambda threshold: not ground_truth.positives(threshold).rows.size, thresholds))
    if without == thresholds:
        tell("warning: the ground truth has no correct image for any query; every recall will be 0")
    elif without:
        words = ", ".join(threshold_words(ground_truth.unit, threshold).strip() for threshold in without)
        remedy = "larger recall.tolerances" + ", or fewer dataset.exclude_neighbors" * (excluded is not None)
        tell(f"warning: no query has a correct image within {words}; recall will be 0 there; use {remedy}")
