"""The inputs of a program as values: data, pipeline, cache, and what counts as correct, from its settings."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from mfvpr.cli import build, notes, truth
from mfvpr.cli.console import Progress, tell
from mfvpr.core.types import Shortlist
from mfvpr.datasets import Dataset
from mfvpr.datasets.contents import Contents, own_rows
from mfvpr.evaluation import EvaluationProtocol, Pipeline, evaluation_protocol, match_sequence
from mfvpr.evaluation.protocol import Split
from mfvpr.evaluation.sequence_matching import matches_recipe
from mfvpr.evaluation.system import folders_of
from mfvpr.matchers import MatchSet, Scales
from mfvpr.storage import FeatureCache
from mfvpr.systems import assembly
from mfvpr.utils import Stopwatch
from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class Inputs:
    """The inputs of a program."""

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


def with_image_size(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings with the image size that `features.image_size=auto`, or a number of pixels, leaves to the images."""
    if isinstance(settings["features"]["image_size"], list | None):
        return settings
    dataset = dataset_of(settings["dataset"])
    pipeline = assembly.pipeline(settings, dataset)
    size = pipeline.size_for_images(folders_of(dataset), lambda line: tell(f"warning: {line}"))
    return {**settings, "features": {**settings["features"], "image_size": [*size]}}


def prepare(settings: Mapping[str, Any], watch: Stopwatch) -> Inputs:
    """The inputs that the settings name; notes and warnings tell what is peculiar about them.

    The pipeline comes first, since its errors should come before anything slow, unless it needs files about the images.
    """
    runtime = build.runtime(settings["devices"], settings["memory"], settings.get("cluster"))
    cache = build.cache(settings["cache"], runtime, on_bad_image=settings["on_bad_image"])
    names = {settings[group]["name"] for group in ("features", "retrieval", "matching")}
    pipeline = None if names & {"import", "pairs"} else assembly.pipeline(settings, None)
    with watch("data"):
        dataset, contents = _data(settings["dataset"], cache)
        ground_truth = truth.describe(settings["dataset"], settings["recall"], dataset)
        notes.tell_peculiarities(dataset, contents, ground_truth.get("thresholds", []))
        if settings["retrieval"]["name"] != "pairs":  # whose numbers of candidates are not known yet
            notes.note_candidates(settings["candidates"], settings["recall"]["ks"], dataset.database)
        groups = {group: settings[group] for group in ("features", "matching")}
        notes.warn_of_matching(groups, assembly.weights(settings), dataset.name, contents)
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


def dataset_of(settings: Mapping[str, Any]) -> Dataset:
    """The data set, with a progress bar if it must be drawn."""
    with Progress("drawing streets", 0) as progress:
        return build.dataset(settings, progress.reach)
