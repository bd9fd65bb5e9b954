"""Images -> features -> shortlist and matches: the stages that every program begins with."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import build, stores
from mfvpr import pipeline
from mfvpr.data.datasets import Dataset, ImageFolder, fingerprint
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet
from mfvpr.types import Features, Shortlist


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
    """A data set with the fingerprints of its folders."""

    dataset: Dataset
    fingerprints: dict[str, str]  # by side

    @property
    def sides(self) -> dict[str, ImageFolder]:
        """Both folders."""
        return {"database": self.dataset.database, "query": self.dataset.queries}


@dataclass(frozen=True)
class Extractors:
    """What features and global descriptors come from."""

    local: LocalExtractor
    describer: Callable[[Sequence[Features]], GlobalExtractor]


@dataclass(frozen=True)
class Extracted:
    """What the images became, before anything is matched."""

    extractor: LocalExtractor
    database: FeatureSet
    queries: FeatureSet
    candidates: Shortlist


def images(settings: dict[str, Any]) -> Images:
    """The data set that the settings name."""
    dataset = _dataset(settings["dataset"])
    return Images(dataset, {"database": fingerprint(dataset.database), "query": fingerprint(dataset.queries)})


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
    with watch("filter"):
        candidates = _shortlist(settings, tools.describer, found, {"database": database, "query": queries})
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
    name, recipe = matches_name(settings), stores.matches_recipe(settings, found.fingerprints, num_candidates)
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


def matches_name(settings: dict[str, Any]) -> str:
    """What a run's matches are called."""
    return f"{settings['dataset']['name']} {settings['features']['name']} matches"


def match(settings: dict[str, Any], made: Extracted, **options: Any) -> MatchSet:
    """Matches of all queries with their candidates."""
    return pipeline.match(
        made.queries, made.database, made.candidates, **settings["matching"], **options, track=build.track("matching")
    )


def _is_one_of_many(settings: dict[str, Any]) -> bool:
    """A job of a multirun, whose others may be making the same features; see `launch`."""
    return settings.get("multirun", False)


def _num_candidates(settings: dict[str, Any], found: Images) -> int:
    asked, available = settings["candidates"], len(found.dataset.database)
    return available if asked == "all" else min(asked, available)


def _dataset(settings: dict[str, Any]) -> Dataset:
    bar: list[tqdm] = []

    def progress(done: int, total: int) -> None:
        if not bar:
            bar.append(build.bar("drawing streets", total))
        bar[0].update(done - bar[0].n)

    try:
        return build.dataset(settings, progress)
    finally:
        for one in bar:
            one.close()


def _warn(dataset: Dataset, database: FeatureSet, queries: FeatureSet) -> None:
    for found, images in ((database, dataset.database), (queries, dataset.queries)):
        for reason in found.bad.values():
            print(f"warning: {reason}", file=sys.stderr)
        empty = [row for row in np.flatnonzero(~found.features.mask.any(axis=1)) if row not in found.bad]
        if empty:
            print(f"warning: {images.paths[empty[0]]}: no keypoints, so no matches ({len(empty)} such images of "
                  f"{len(images)}); scores are 0", file=sys.stderr)  # fmt: skip
    if dataset.truth is not None and all(dataset.truth.place(row) is None for row in range(len(dataset.queries))):
        print("warning: the ground truth gives no query a place; every recall will be 0", file=sys.stderr)


def _features(
    settings: dict[str, Any], extractor: LocalExtractor, side: str, folder: ImageFolder, images: str
) -> FeatureSet:
    chosen, label = settings["features"], f"{side} features"
    name = f"{settings['dataset']['name']} {side} {chosen['name']}"
    wait = _is_one_of_many(settings)
    with stores.opened(settings["store"], name, folder, extractor, chosen, images, wait=wait) as store:
        skip_bad = settings["on_bad_image"] == "skip"
        return pipeline.extract(folder, extractor, store=store, skip_bad=skip_bad, track=build.track(label))


def _shortlist(
    settings: dict[str, Any],
    describer: Callable[[Sequence[Features]], GlobalExtractor],
    found: Images,
    features: dict[str, FeatureSet],
) -> Shortlist:
    asked, available = settings["candidates"], len(found.dataset.database)
    if asked != "all" and asked > available:
        print(
            f"note: candidates={asked}, but the database has {available} images; all of them are re-ranked",
            file=sys.stderr,
        )
    chosen, database = settings["retrieval"], features["database"]
    extractor = describer([database[row] for row in range(len(database))])
    root = settings["store"] if extractor.image_size is not None else None  # VLAD takes no time
    skip_bad, wait, descriptors = settings["on_bad_image"] == "skip", _is_one_of_many(settings), {}
    for side, folder in found.sides.items():
        name = f"{settings['dataset']['name']} {side} {chosen['name']}"
        with stores.opened(root, name, folder, extractor, chosen, found.fingerprints[side], wait=wait) as store:
            descriptors[side] = pipeline.describe(
                folder, features[side], extractor, store=store, skip_bad=skip_bad,
                track=build.track(f"{side} descriptors"),
            )  # fmt: skip
    return pipeline.shortlist(descriptors["query"], descriptors["database"], _num_candidates(settings, found))
