"""The stages of the main job, in the order of the data's way."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from experiments import build
from mfvpr import pipeline
from mfvpr.data.datasets import Dataset, fingerprint
from mfvpr.data.files import write_text
from mfvpr.data.images import read_image, resize
from mfvpr.evaluation import recall_at_k
from mfvpr.features import LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet
from mfvpr.report import runs
from mfvpr.report.figures import histogram_figure
from mfvpr.report.tables import Table
from mfvpr.scoring import HistogramOfShifts
from mfvpr.types import Shortlist


@dataclass(frozen=True)
class System:
    """One line of the table: a ranking and what made it."""

    scorer: str
    parameters: dict[str, Any]
    rows: np.ndarray  # [Q, C] database rows, best first
    scores: np.ndarray  # [Q, C] in that order


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
    folder = Path(settings["out"]).expanduser() if settings["out"] else None
    if folder:
        runs.check_free(folder)
    watch = Stopwatch()
    with watch("data"):
        dataset = _dataset(settings["dataset"])
        data = fingerprint([dataset.database, dataset.queries])
    skip_bad = settings["on_bad_image"] == "skip"
    extractor = build.local_extractor(settings["features"])
    with watch("features"):
        database = pipeline.extract(
            dataset.database, extractor, skip_bad=skip_bad, track=build.track("database features")
        )
        queries = pipeline.extract(dataset.queries, extractor, skip_bad=skip_bad, track=build.track("query features"))
    _warn_of_bad(database, queries)
    with watch("filter"):
        candidates = _shortlist(settings, dataset, database, queries, skip_bad)
    with watch("matching"):
        matches = pipeline.match(queries, database, candidates, **settings["matching"], track=build.track("matching"))
    scorers = build.scorers(settings["scorer"])
    with watch("scores"):
        systems = _systems(settings, scorers, matches, candidates)

    rows = _result_rows(settings, dataset, systems, candidates, watch.seconds, data)
    table = _table(rows)
    folder = folder or runs.new_run_folder(Path("runs"), dataset.name)
    shown = scorers.get("histogram", HistogramOfShifts())
    with runs.writing(folder) as new:
        _write(new, dataset, rows, table, systems, database, queries)
        _figures(new, settings, dataset, extractor, systems, shown, matches, candidates)  # type: ignore[arg-type]
    print(f"\n{_heading(dataset, settings, candidates)}\n\n{table.text()}\nresults: {folder}")


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


def _warn_of_bad(database: FeatureSet, queries: FeatureSet) -> None:
    for reason in (*database.bad.values(), *queries.bad.values()):
        print(f"warning: {reason}", file=sys.stderr)


def _shortlist(
    settings: dict[str, Any], dataset: Dataset, database: FeatureSet, queries: FeatureSet, skip_bad: bool
) -> Shortlist:
    asked, available = settings["candidates"], len(dataset.database)
    if asked != "all" and asked > available:
        print(f"candidates={asked}: the database has {available} images; all of them are re-ranked", file=sys.stderr)
    extractor = build.global_extractor(settings["retrieval"], [database[row] for row in range(len(database))])
    descriptors = [
        pipeline.describe(folder, features, extractor, skip_bad=skip_bad, track=build.track(f"{name} descriptors"))
        for name, folder, features in (("database", dataset.database, database), ("query", dataset.queries, queries))
    ]
    return pipeline.shortlist(descriptors[1], descriptors[0], available if asked == "all" else min(asked, available))


def _systems(settings: dict[str, Any], scorers: dict, matches: MatchSet, candidates: Shortlist) -> dict[str, System]:
    """The filter alone, each scorer, and the best of them (the paper: histogram) combined with the filter."""
    scores = pipeline.score(scorers, matches, candidates, track=build.track("scores"))
    group = settings["scorer"]
    parameters = {name: group if "method" in group else group[name] for name in scorers}
    combined = "histogram" if "histogram" in scorers else next(iter(scorers))
    c = settings["fusion"]["c"]
    found = {"filter": ("none", {}, candidates.scores)}
    found |= {name: (name, parameters[name], scores[name]) for name in scorers}
    fused = pipeline.fuse(candidates, scores[combined], None if c == "auto" else c)
    found[f"{combined} + filter"] = (combined, parameters[combined] | {"c": c}, fused)
    return {name: _system(candidates, *values) for name, values in found.items()}


def _system(candidates: Shortlist, scorer: str, parameters: dict[str, Any], scores: np.ndarray) -> System:
    order = pipeline.rank(candidates, scores)
    return System(
        scorer=scorer,
        parameters=parameters,
        rows=np.take_along_axis(candidates.indices, order, axis=1),
        scores=np.take_along_axis(scores, order, axis=1),
    )


def _result_rows(
    settings: dict[str, Any], dataset: Dataset, systems: dict[str, System], candidates: Shortlist,
    seconds: dict[str, float], data: str,
) -> list[dict[str, Any]]:  # fmt: skip
    common = {
        "filter": settings["retrieval"],
        "features": settings["features"],
        "matching": settings["matching"],
        "candidates": int(candidates.indices.shape[1]),
        "queries": len(dataset.queries),
        "database": len(dataset.database),
        "dataset": dataset.name,
        "data_fingerprint": data,
        "seconds": seconds,
        "versions": runs.versions(),
    }
    ks = settings["recall"]["ks"]
    thresholds: list[tuple[dict[str, float], np.ndarray | None]] = [({}, None)]
    if dataset.truth:
        name = "tolerance" if dataset.truth.unit == "frames" else "radius"
        thresholds = [({name: value}, dataset.truth.positives(value)) for value in _thresholds(settings, dataset)]

    def recall(rows: np.ndarray, positives: np.ndarray | None) -> dict[str, float]:
        if positives is None:
            return {}
        return {str(k): round(float(value), 6) for k, value in zip(ks, recall_at_k(rows, positives, ks), strict=True)}

    return [
        {"system": name, "scorer": system.scorer, "parameters": system.parameters, **threshold,
         "recall_at": recall(system.rows, positives), **common}
        for name, system in systems.items()
        for threshold, positives in thresholds
    ]  # fmt: skip


def _thresholds(settings: dict[str, Any], dataset: Dataset) -> list[float]:
    """What counts as right, in the unit of the ground truth."""
    in_frames = dataset.truth is not None and dataset.truth.unit == "frames"
    return settings["recall"]["tolerances"] if in_frames else [settings["recall"]["radius"]]


def _table(rows: list[dict[str, Any]]) -> Table:
    """R@first k at every tolerance, and all ks at the middle one."""
    systems = list(dict.fromkeys(row["system"] for row in rows))
    per_system = [[row for row in rows if row["system"] == system] for system in systems]
    middle = len(per_system[0]) // 2

    def cells(found: list[dict[str, Any]]) -> list[tuple[str, str]]:
        def label(row: dict[str, Any], k: str) -> str:
            return f"R@{k} ±{row['tolerance']}" if "tolerance" in row else f"R@{k} {row['radius']:g} m"

        first = [(row, k) for row in found for k in list(row["recall_at"])[:1]]
        others = [(found[middle], k) for k in list(found[middle]["recall_at"])[1:]]
        return [(label(row, k), f"{100 * row['recall_at'][k]:.1f}") for row, k in first + others]

    header = ["system", *(name for name, _ in cells(per_system[0]))]
    lines = zip(systems, per_system, strict=True)
    return Table(header, [[system, *(text for _, text in cells(found))] for system, found in lines])


def _heading(dataset: Dataset, settings: dict[str, Any], candidates: Shortlist) -> str:
    kind = "no ground truth: rankings only" if dataset.truth is None else f"recall in %, ± in {dataset.truth.unit}"
    return (
        f"{dataset.name}: {len(dataset.queries)} queries, {len(dataset.database)} database images, "
        f"{candidates.indices.shape[1]} candidates ({settings['retrieval']['name']}), "
        f"{settings['features']['name']} features; {kind}"
    )


def _write(
    folder: Path, dataset: Dataset, rows: list[dict[str, Any]], table: Table, systems: dict[str, System],
    database: FeatureSet, queries: FeatureSet,
) -> None:  # fmt: skip
    runs.write_results(folder, rows)
    runs.write_table(folder, table)
    names = dataset.queries.names, dataset.database.names
    for name, system in systems.items():
        file = folder / "predictions" / f"{name.replace(' + ', '_')}.csv"
        runs.write_predictions(file, *names, system.rows, system.scores)
    headline = systems[_headline(systems)]
    runs.write_predictions(folder / "predictions.csv", *names, headline.rows, headline.scores)
    bad = [("database", dataset.database.names[row], reason) for row, reason in database.bad.items()]
    bad += [("queries", dataset.queries.names[row], reason) for row, reason in queries.bad.items()]
    if bad:
        write_text(folder / "skipped.csv", Table(["folder", "image", "reason"], bad).csv())


def _headline(systems: dict[str, System]) -> str:
    """The system that predictions.csv and the figures show: the histogram, else the scorer that was asked for."""
    return "histogram" if "histogram" in systems else list(systems)[1]


def _figures(
    folder: Path, settings: dict[str, Any], dataset: Dataset, extractor: LocalExtractor, systems: dict[str, System],
    scorer: HistogramOfShifts, matches: MatchSet, candidates: Shortlist,
) -> None:  # fmt: skip
    """The paper's figure for a few queries, right and wrong ones, spread over the sequence."""
    name = _headline(systems)
    best = systems[name].rows[:, 0]
    verdicts = _shown(best, settings, dataset)
    queries, database = dataset.queries, dataset.database
    for query, verdict in build.track("figures")(verdicts.items(), len(verdicts)):
        paths = queries.paths[query], database.paths[best[query]]
        images = [resize(read_image(path), extractor.image_size, extractor.interpolation) for path in paths]
        place = int(np.flatnonzero(candidates.indices[query] == best[query])[0])
        histogram_figure(
            folder / "figures" / f"{verdict.split()[0]}_{query:04d}.png",
            images[0],
            images[1],
            jax.tree.map(lambda field: field[place], matches[query]),  # noqa: B023
            scorer,
            title=f"{name}, {verdict}: {queries.names[query]} -> {database.names[best[query]]}",
        )


def _shown(best: np.ndarray, settings: dict[str, Any], dataset: Dataset) -> dict[int, str]:
    """Queries that get a figure, with what became of them: half right, half wrong where that can be told."""
    number, found = settings["figures"], best >= 0
    if dataset.truth is None:
        return dict.fromkeys(_spread(np.flatnonzero(found), number), "first")
    threshold = _thresholds(settings, dataset)
    positives = dataset.truth.positives(threshold[len(threshold) // 2])
    right = positives[np.arange(len(best)), np.maximum(best, 0)] & found
    shown = dict.fromkeys(_spread(np.flatnonzero(right), (number + 1) // 2), "right")
    for query in _spread(np.flatnonzero(found & ~right), number // 2):
        places = np.flatnonzero(positives[query])
        true = dataset.database.names[places[len(places) // 2]] if len(places) else "not in the database"
        shown[query] = f"wrong (truth: {true})"
    return shown


def _spread(items: np.ndarray, number: int) -> list[int]:
    """At most `number` of the items, evenly spaced."""
    places = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [int(items[place]) for place in places]
