"""Images -> features -> shortlist and matches: the stages that every program begins with."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

from tqdm import tqdm

from experiments import build, truth
from experiments.console import bar, tell
from mfvpr.datasets import Dataset, QuerySequence
from mfvpr.datasets.contents import Contents
from mfvpr.datasets.published import differences
from mfvpr.datasets.sequences import OwnRows, own_rows, without_neighbors
from mfvpr.datasets.truth import threshold_words
from mfvpr.evaluation import match_sequence
from mfvpr.evaluation.sequence_matching import matches_recipe
from mfvpr.features import Extractor, Source
from mfvpr.matching import Matcher, MatchSet, Scales
from mfvpr.retrieval import ExactSearch, Filter, Retrieval
from mfvpr.scoring.weight_registry import how_made
from mfvpr.storage import Archive
from mfvpr.types import Shortlist
from mfvpr.utils import Stopwatch

__all__ = ["Images", "Tools", "begun", "matched", "recipe"]


_LEARNED_WITH = {"features": ("name", "weights"), "matching": ("name", "cross_check")}  # what a match weight depends on


@dataclass(frozen=True)
class Images:
    """A data set with what its files hold."""

    dataset: Dataset
    contents: Mapping[str, Contents]  # by side

    @property
    def fingerprints(self) -> dict[str, str]:
        """Of all folders, by side."""
        return {side: found.fingerprint for side, found in self.contents.items()}

    @property
    def reading(self) -> dict[str, Any]:
        """What reading does to the images, by side."""
        return {side: found.summary() for side, found in self.contents.items()}


@dataclass(frozen=True)
class Tools:
    """What features, candidates and matches are made with, and where that is kept."""

    extractor: Extractor | Source
    filter: Filter
    matching: Matcher
    archive: Archive
    where: Mapping[str, Any]  # memory and devices


def begun(settings: dict[str, Any], watch: Stopwatch) -> tuple[Tools, Images]:
    """The tools and the data set that the settings name.

    What is wrong with the tools is told before anything slow, but of files of others, which belong to images.
    """
    archive = build.archive(settings)
    names = {settings[group]["name"] for group in ("features", "retrieval")}
    early = None if names & {"import", "pairs"} else _tools(settings, archive, None)
    with watch("data"):
        images = _images(settings, archive)
    return early or _tools(settings, archive, images.dataset), images


def _tools(settings: dict[str, Any], archive: Archive, dataset: Dataset | None) -> Tools:
    extractor = build.extractor(settings["features"], dataset)
    retrieval = build.filter(settings["retrieval"], extractor, dataset)
    if settings.get("coordinator"):
        retrieval = _spread(retrieval)
    return Tools(extractor, retrieval, build.matching(settings["matching"]), archive, build.where(settings))


def _spread(filter: Filter) -> Filter:
    """The same on the devices of all tasks, where it searches exactly."""
    from mfvpr.evaluation.distributed import retrieve_everywhere  # which few need

    if not isinstance(filter, Retrieval) or not isinstance(filter.search, ExactSearch):
        return filter
    return replace(filter, search=replace(filter.search, spread=retrieve_everywhere))


def _images(settings: dict[str, Any], archive: Archive) -> Images:
    """The data set that the settings name."""
    dataset, neighbors = dataset_of(settings["dataset"]), settings["dataset"].get("exclude_neighbors")
    sides = {"database": archive.contents(dataset.database)}
    several, sequences, own = len(dataset.sequences) > 1, [], []
    for sequence in dataset.sequences:
        contents = archive.contents(sequence.images)
        sides[f"query {sequence.name}" if several else "query"] = contents
        own.append(own_rows(contents, sides["database"]))
        if neighbors is not None:
            sequence = without_neighbors(sequence, len(dataset.database), own[-1], neighbors)
        sequences.append(sequence)
    images = Images(replace(dataset, sequences=tuple(sequences)), sides)
    _warn_of_images(settings, images, own)
    _warn_of_weights(settings, images)
    return images


def matched(
    settings: dict[str, Any], tools: Tools, images: Images, watch: Stopwatch
) -> tuple[MatchSet | Scales, Shortlist]:
    """Matches and shortlist of the only sequence, from their store where they are all there."""
    result = match_sequence(
        images.dataset, images.dataset.only, tools.extractor, tools.filter, settings["candidates"],
        matching=tools.matching, archive=tools.archive, watch=watch, **tools.where,
    )  # fmt: skip
    return result.by_scale, result.candidates


def recipe(tools: Tools, images: Images, num_candidates: int) -> dict[str, Any]:
    """Of the shortlist and the matches of the only sequence, and of how several scales are fused."""
    recipe = matches_recipe(
        images.dataset, images.dataset.only, tools.extractor, tools.filter, num_candidates, tools.matching,
        tools.archive,
    )  # fmt: skip
    scales = tools.extractor.scales
    return recipe | ({"scale_weights": [scale.weight for scale in scales]} if len(scales) > 1 else {})


def num_candidates(settings: Mapping[str, Any], images: Images) -> int:
    """How many a query has at most."""
    number = len(images.dataset.database)
    return number if settings["candidates"] == "all" else min(settings["candidates"], number)


def dataset_of(settings: dict[str, Any]) -> Dataset:
    """The data set, with progress where it is drawn."""
    bars: list[tqdm] = []

    def progress(done: int, total: int) -> None:
        if not bars:
            bars.append(bar("drawing streets", total))
        bars[0].update(done - bars[0].n)

    try:
        return build.dataset(settings, progress)
    finally:
        for progress_bar in bars:
            progress_bar.close()


def _warn_of_images(settings: dict[str, Any], images: Images, own: list[OwnRows]) -> None:
    """What is in the data set that may give wrong numbers, and what was done about it."""
    dataset = images.dataset
    for difference in differences(dataset):
        tell(f"warning: {dataset.name}: {difference}; its numbers are not comparable")
    for sequence, rows in zip(dataset.sequences, own, strict=True):
        _warn_of_sequence(settings, sequence, rows)
    for side, did in images.reading.items():
        if did["turned"]:
            tell(f"note: {did['turned']} {side} images are turned as their EXIF orientation says")
        if did["scaled_16bit"]:
            tell(f"note: {did['scaled_16bit']} 16-bit {side} images are scaled to 8 bits")
    bits, largest = dataset.database.bits, max(did["largest_16bit"] or 0 for did in images.reading.values())
    used = max(largest.bit_length(), 8)
    if largest and bits is not None and not bits - 1 <= used <= bits:
        look = "dark" if used < bits else "cut off"
        tell(f"warning: the largest value of all 16-bit images is {largest}, so that they come out {look}; "
              f"dataset.bits={used} would use their range")  # fmt: skip
    if settings["features"]["name"] == "import" and settings["matching"]["name"] == "lightglue":
        tell("warning: matching=lightglue knows ALIKED's features alone; what features=import gives must be these")
    candidates, available = settings["candidates"], num_candidates(settings, images)
    if candidates != "all" and candidates > available:
        tell(f"note: candidates={candidates}, but the database has {available} images; all of them are re-ranked")
    deeper = [f"R@{k}" for k in settings["recall"]["ks"] if k > available]
    if deeper:
        verb = "is" if len(deeper) == 1 else "are"
        tell(f"note: {' and '.join(deeper)} {verb} R@{available}, of the filter too: no more candidates are looked at")


def _warn_of_weights(settings: dict[str, Any], images: Images) -> None:
    """What a learned match weight was learned on, where that may give wrong numbers."""
    chosen = {one.get("weight", "fs") for one in build.by_scorer(settings["scorer"]).values()}
    for name in sorted(chosen | {*((settings.get("grid") or {}).get("weight") or ())}):
        made = how_made(name)
        sets = made["data_sets"] if isinstance(made.get("data_sets"), list) else [made]
        seen = {str(folder) for one in sets for folder in _part(one, "data_fingerprint").values()}
        if seen & {*images.fingerprints.values()}:
            tell(f"warning: weight={name} was learned on images of {images.dataset.name}, so that it flatters here")
        for group, keys in _LEARNED_WITH.items() if made else ():
            before, now = _part(_part(made, "settings"), group), settings[group]
            if other := [key for key in keys if before.get(key) != now.get(key)]:
                words = ", ".join(f"{before.get(key, 'unknown')} instead of {now.get(key)}" for key in other)
                tell(f"warning: weight={name} was learned with other {group} ({words}); it may mean nothing here")


def _part(content: Any, name: str) -> Mapping[str, Any]:
    """Of what a file says; empty where that is anything else."""
    found = content.get(name) if isinstance(content, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _warn_of_sequence(settings: dict[str, Any], sequence: QuerySequence, own: OwnRows) -> None:
    among, excluded = sum(map(bool, own)), sequence.excluded
    if among and excluded is None:
        tell(f"warning: {among} of {len(own)} queries are database images themselves, so that each finds itself; set "
              "dataset.exclude_neighbors=N to leave out what is within N frames of it (0 = itself alone)")  # fmt: skip
    if excluded is not None and among < len(own):
        tell(f"note: {len(own) - among} of {len(own)} queries are no database images; nothing is left out for them")
    ground_truth, thresholds = sequence.truth, truth.thresholds(settings, sequence.truth)
    if ground_truth is None:
        return
    without = list(takewhile(lambda threshold: not ground_truth.positives(threshold).any(), thresholds))
    if without == thresholds:
        tell("warning: the ground truth gives no query a right answer; every recall will be 0")
    elif without:
        words = ", ".join(threshold_words(ground_truth.unit, threshold).strip() for threshold in without)
        mend = "larger recall.tolerances" + ", or fewer dataset.exclude_neighbors" * (excluded is not None)
        tell(f"warning: no query has a right answer within {words}, so that recall will be 0 there; use {mend}")
