"""The stages of the main job, in the order of the data's way."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import build, outputs, stores
from experiments.outputs import Outcome, System
from mfvpr import pipeline
from mfvpr.data.datasets import Dataset, ImageFolder, fingerprint
from mfvpr.features import GlobalExtractor, LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet
from mfvpr.report import runs
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


def evaluate(settings: dict[str, Any]) -> None:
    """Images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""
    folder = build.expanded(settings["out"]) if settings["out"] else None
    runs.check_free(folder or runs.new_run_folder(Path("runs"), settings["dataset"]["name"]))
    scorers = build.scorers(settings["scorer"])
    extractor = build.local_extractor(settings["features"])
    describer = build.global_extractor(settings["retrieval"])
    watch = Stopwatch()
    with watch("data"):
        dataset = _dataset(settings["dataset"])
        sides = {"database": dataset.database, "query": dataset.queries}
        data = {side: fingerprint(folder) for side, folder in sides.items()}
    with watch("features"):
        database, queries = (_features(settings, extractor, side, sides[side], data[side]) for side in sides)
    _warn(dataset, database, queries)
    with watch("filter"):
        candidates = _shortlist(settings, describer, sides, data, {"database": database, "query": queries})
    with watch("matching"):
        matches = pipeline.match(queries, database, candidates, **settings["matching"], track=build.track("matching"))
    with watch("scores"):
        systems = _systems(settings, scorers, matches, candidates)

    outcome = Outcome(
        settings, dataset, extractor, database, queries, candidates, matches, scorers, systems, watch.seconds, data
    )
    folder = folder or runs.new_run_folder(Path("runs"), dataset.name)
    with runs.writing(folder) as new:
        table = outputs.write(new, outcome)
    shown = f"{table.text()}\n" if outcome.thresholds else ""
    print(f"\n{outputs.heading(outcome)}\n\n{shown}results: {folder}")


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
    with stores.opened(settings["store"], name, folder, extractor, chosen, images) as store:
        skip_bad = settings["on_bad_image"] == "skip"
        return pipeline.extract(folder, extractor, store=store, skip_bad=skip_bad, track=build.track(label))


def _shortlist(
    settings: dict[str, Any],
    describer: Callable[[Sequence[Features]], GlobalExtractor],
    sides: dict[str, ImageFolder],
    images: dict[str, str],
    features: dict[str, FeatureSet],
) -> Shortlist:
    asked, available = settings["candidates"], len(sides["database"])
    if asked != "all" and asked > available:
        print(
            f"note: candidates={asked}, but the database has {available} images; all of them are re-ranked",
            file=sys.stderr,
        )
    chosen, database = settings["retrieval"], features["database"]
    extractor = describer([database[row] for row in range(len(database))])
    root = settings["store"] if extractor.image_size is not None else None  # VLAD takes no time
    skip_bad, descriptors = settings["on_bad_image"] == "skip", {}
    for side, folder in sides.items():
        name = f"{settings['dataset']['name']} {side} {chosen['name']}"
        with stores.opened(root, name, folder, extractor, chosen, images[side]) as store:
            descriptors[side] = pipeline.describe(
                folder, features[side], extractor, store=store, skip_bad=skip_bad,
                track=build.track(f"{side} descriptors"),
            )  # fmt: skip
    wanted = available if asked == "all" else min(asked, available)
    return pipeline.shortlist(descriptors["query"], descriptors["database"], wanted)


def _systems(settings: dict[str, Any], scorers: dict, matches: MatchSet, candidates: Shortlist) -> dict[str, System]:
    """The filter alone, each scorer, and the best of them (the paper: histogram) combined with the filter."""
    scores = pipeline.score(scorers, matches, candidates, track=build.track("scores"))
    group = settings["scorer"]
    parameters = {name: group if "method" in group else group[name] for name in scorers}
    combined = "histogram" if "histogram" in scorers else next(iter(scorers))
    c, euclidean = settings["fusion"]["c"], settings["fusion"]["filter_score"] == "negative_euclidean"
    found = {"filter": ("none", {}, candidates.scores)}
    found |= {name: (name, parameters[name], scores[name]) for name in scorers}
    fused = pipeline.fuse(candidates, scores[combined], None if c == "auto" else c, euclidean=euclidean)
    found[f"{combined} + filter"] = (combined, parameters[combined] | settings["fusion"], fused)
    return {name: _system(candidates, settings["ties"], *values) for name, values in found.items()}


def _system(candidates: Shortlist, ties: Any, scorer: str, parameters: dict[str, Any], scores: np.ndarray) -> System:
    order = pipeline.rank(candidates, scores, ties=ties)
    return System(
        scorer=scorer,
        parameters=parameters,
        rows=np.take_along_axis(candidates.indices, order, axis=1),
        scores=np.take_along_axis(scores, order, axis=1),
    )
