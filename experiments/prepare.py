"""Images -> features -> shortlist and matches: the stages that every program begins with."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import build, stores, truth
from experiments.console import bar, tell, track
from mfvpr import pipeline
from mfvpr.data.contents import Contents, contents
from mfvpr.data.datasets import Dataset, ImageFolder
from mfvpr.data.sequences import OwnRows, own_rows, without_neighbors
from mfvpr.evaluation import threshold_words
from mfvpr.extraction import Descriptors
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet
from mfvpr.types import Shortlist


@dataclass
class Stopwatch:
    """Seconds per stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 3)


@dataclass(frozen=True)
class Images:
    """A data set with what its files hold."""

    dataset: Dataset
    contents: dict[str, Contents]  # by side

    @property
    def fingerprints(self) -> dict[str, str]:
        """Of both folders, by side."""
        return {side: found.fingerprint for side, found in self.contents.items()}

    @property
    def reading(self) -> dict[str, Any]:
        """What reading does to the images, by side."""
        return {side: found.summary() for side, found in self.contents.items()}

    @property
    def sides(self) -> dict[str, ImageFolder]:
        """Both folders."""
        return {"database": self.dataset.database, "query": self.dataset.queries}


@dataclass(frozen=True)
class Extractors:
    """What features and global descriptors come from."""

    local: LocalExtractor
    describer: Callable[[FeatureSet], GlobalExtractor]


@dataclass(frozen=True)
class Extracted:
    """What the images became, before anything is matched."""

    extractor: LocalExtractor
    database: FeatureSet
    queries: FeatureSet
    candidates: Shortlist


def images(settings: dict[str, Any]) -> Images:
    """The data set that the settings name."""
    dataset, neighbors = _dataset(settings["dataset"]), settings["dataset"].get("exclude_neighbors")
    remembered = build.expanded(settings["store"]) / "contents" if settings["store"] else None
    database, queries = (contents(folder, remembered) for folder in (dataset.database, dataset.queries))
    own = own_rows(queries, database)
    if neighbors is not None:
        dataset = without_neighbors(dataset, own, neighbors)
    found = Images(dataset, {"database": database, "query": queries})
    _warn_of_images(settings, found, own)
    return found


def extractors(settings: dict[str, Any]) -> Extractors:
    """Before anything slow: what is wrong with them is told first."""
    return Extractors(build.local_extractor(settings["features"]), build.global_extractor(settings["retrieval"]))


def extracted(settings: dict[str, Any], tools: Extractors, found: Images, watch: Stopwatch) -> Extracted:
    """Features of all images, and the filter's candidates."""
    with watch("features"):
        database, queries = (
            _features(settings, tools.local, side, folder, found.fingerprints[side])
            for side, folder in found.sides.items()
        )
    _warn(found.dataset, database, queries)
    excluded = found.dataset.excluded
    with watch("filter"):
        described = _described(settings, tools.describer, found, {"database": database, "query": queries})
        candidates = pipeline.shortlist(
            described["query"].values,
            described["database"].values,
            _num_candidates(settings, found),
            allowed=None if excluded is None else ~excluded.dense(),
        )
    database, queries = (
        replace(one, bad=described[side].bad) for side, one in (("database", database), ("query", queries))
    )
    return Extracted(tools.local, database, queries, candidates)


def matched(
    settings: dict[str, Any], tools: Extractors, found: Images, watch: Stopwatch, **options: Any
) -> tuple[MatchSet, Shortlist]:
    """Matches and shortlist, from their store where they are all there; then no features are read.

    `options` are those of `pipeline.match` that the settings do not have.
    """
    if settings["store"] is None:
        made = extracted(settings, tools, found, watch)
        with watch("matching"):
            return match(settings, made, **options), made.candidates
    num_candidates = _num_candidates(settings, found)
    name = f"{settings['dataset']['name']} {settings['features']['name']} matches"
    recipe = stores.matches_recipe(settings, found.fingerprints, num_candidates)
    typical = tools.local.typical_count // 3  # of mutual nearest neighbors
    queries = len(found.dataset.queries)
    sizes = queries, num_candidates, typical
    with stores.opened_matches(settings["store"], name, recipe, *sizes, wait=_is_one_of_many(settings)) as store:
        if not store.done.all():
            made = extracted(settings, tools, found, watch)
            with watch("matching"):
                return match(settings, made, store=store, **options), made.candidates
        with watch("matches read"):
            return pipeline.stored_matches(store)


def match(settings: dict[str, Any], made: Extracted, **options: Any) -> MatchSet:
    """Matches of all queries with their candidates."""
    return pipeline.match(
        made.queries, made.database, made.candidates, **settings["matching"], **options, track=track("matching")
    )


def _is_one_of_many(settings: dict[str, Any]) -> bool:
    """A job of a multirun, whose others may be making the same features; see `launch`."""
    return settings.get("multirun", False)


def _num_candidates(settings: dict[str, Any], found: Images) -> int:
    asked, available = settings["candidates"], len(found.dataset.database)
    return available if asked == "all" else min(asked, available)


def _dataset(settings: dict[str, Any]) -> Dataset:
    bars: list[tqdm] = []

    def progress(done: int, total: int) -> None:
        if not bars:
            bars.append(bar("drawing streets", total))
        bars[0].update(done - bars[0].n)

    try:
        return build.dataset(settings, progress)
    finally:
        for one in bars:
            one.close()


def _warn_of_images(settings: dict[str, Any], found: Images, own: OwnRows) -> None:
    """What is in the data set that may give wrong numbers, and what was done about it."""
    dataset, among = found.dataset, sum(map(bool, own))
    if among and dataset.excluded is None:
        tell(f"warning: {among} of {len(own)} queries are database images themselves, so that each finds itself; set "
              "dataset.exclude_neighbors=N to leave out what is within N frames of it (0 = itself alone)")  # fmt: skip
    if dataset.excluded is not None and among < len(own):
        tell(f"note: {len(own) - among} of {len(own)} queries are no database images; nothing is left out for them")
    for side, did in found.reading.items():
        if did["turned"]:
            tell(f"note: {did['turned']} {side} images are turned as their EXIF orientation says")
        if did["scaled_16bit"]:
            tell(f"note: {did['scaled_16bit']} 16-bit {side} images are scaled to 8 bits")
    bits, largest = dataset.database.bits, max(did["largest_16bit"] or 0 for did in found.reading.values())
    used = max(largest.bit_length(), 8)
    if largest and bits is not None and not bits - 1 <= used <= bits:
        look = "dark" if used < bits else "cut off"
        tell(f"warning: the largest value of all 16-bit images is {largest}, so that they come out {look}; "
              f"dataset.bits={used} would use their range")  # fmt: skip
    _warn_of_truth(settings, dataset)
    deepest, available = max(settings["recall"]["ks"]), _num_candidates(settings, found)
    if deepest > available:
        tell(f"note: R@{deepest} is R@{available}, of the filter too: no more candidates are looked at")


def _warn_of_truth(settings: dict[str, Any], dataset: Dataset) -> None:
    """Thresholds, from the lowest on, at which no query has a right answer."""
    found, asked = dataset.truth, truth.thresholds(settings, dataset.truth)
    if found is None:
        return
    without = list(takewhile(lambda threshold: not found.positives(threshold).any(), asked))
    if without == asked:
        tell("warning: the ground truth gives no query a right answer; every recall will be 0")
    elif without:
        words = ", ".join(threshold_words(found.unit, threshold).strip() for threshold in without)
        mend = "larger recall.tolerances" + ", or fewer dataset.exclude_neighbors" * (dataset.excluded is not None)
        tell(f"warning: no query has a right answer within {words}, so that recall will be 0 there; use {mend}")


def _warn(dataset: Dataset, database: FeatureSet, queries: FeatureSet) -> None:
    for found, images in ((database, dataset.database), (queries, dataset.queries)):
        for reason in found.bad.values():
            tell(f"warning: {reason}")
        empty = [row for row in np.flatnonzero(found.counts == 0) if row not in found.bad]
        if empty:
            tell(f"warning: {images.paths[empty[0]]}: no keypoints, so no matches ({len(empty)} such images of "
                 f"{len(images)}); scores are 0")  # fmt: skip


def _features(
    settings: dict[str, Any], extractor: LocalExtractor, side: str, folder: ImageFolder, images: str
) -> FeatureSet:
    chosen, label = settings["features"], f"{side} features"
    name = f"{settings['dataset']['name']} {side} {chosen['name']}"
    wait = _is_one_of_many(settings)
    with stores.opened(settings["store"], name, folder, extractor, chosen, images, wait=wait) as store:
        skip_bad = settings["on_bad_image"] == "skip"
        return pipeline.extract(folder, extractor, store=store, skip_bad=skip_bad, track=track(label))


def _described(
    settings: dict[str, Any],
    describer: Callable[[FeatureSet], GlobalExtractor],
    found: Images,
    features: dict[str, FeatureSet],
) -> dict[str, Descriptors]:
    """Global descriptors by side."""
    asked, available = settings["candidates"], len(found.dataset.database)
    if asked != "all" and asked > available:
        tell(f"note: candidates={asked}, but the database has {available} images; all of them are re-ranked")
    chosen, database = settings["retrieval"], features["database"]
    extractor = describer(database)
    root = settings["store"] if extractor.image_size is not None else None  # VLAD takes no time
    skip_bad, wait, described = settings["on_bad_image"] == "skip", _is_one_of_many(settings), {}
    for side, folder in found.sides.items():
        name = f"{settings['dataset']['name']} {side} {chosen['name']}"
        with stores.opened(root, name, folder, extractor, chosen, found.fingerprints[side], wait=wait) as store:
            described[side] = pipeline.describe(
                folder, features[side], extractor, store=store, skip_bad=skip_bad,
                track=track(f"{side} descriptors"),
            )  # fmt: skip
        for row in described[side].bad.keys() - features[side].bad.keys():
            tell(f"warning: {described[side].bad[row]}")
    return described
