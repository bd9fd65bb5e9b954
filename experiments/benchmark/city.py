"""Retrieval, extraction of shortlisted images and re-ranking among 100,000 images, with a forecast for 2.8 million."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.benchmark.harness import write_report
from experiments.benchmark.scale import CANDIDATES, MEMORY, Counted, Rankings, median_seconds, peak_bytes, rerank
from experiments.benchmark.synthetic_features import BATCH, GLOBAL, SyntheticSet
from experiments.console import bar
from mfvpr.datasets import Positives
from mfvpr.evaluation import recall_at_k
from mfvpr.features import FeatureSet
from mfvpr.report import Table
from mfvpr.reranking import rank
from mfvpr.retrieval.search import EXACT
from mfvpr.storage.features import FeatureStore, forecast_bytes
from mfvpr.storage.rows import require_space
from mfvpr.types import Shortlist

DATA = SyntheticSet(100_000, 200, 700, 128, views=1, likeness=0.18)  # so that retrieval often fails
ROUNDS = 3
WHOLE, ASKED, MACHINES = 2_800_000, 1000, (1, 8, 64)  # images of San Francisco XL, and queries of the forecast
# Seconds per image on 2 cores from experiments/results.md: MixVPR one by one, and the local features of `localize`.
DESCRIBING, EXTRACTING = 0.102, {"SIFT": 0.021, "ALIKED n16": 0.070}
ASSUMED = (
    "all machines and their disks are as fast as the measured ones",
    "global descriptors of the whole database are extracted once, before the queries; they stay in memory, in float32",
    "retrieval compares every query with every image in time proportional to their numbers; the database's rows are "
    "divided evenly over the machines",
    "one machine sorts the candidates of all machines in time proportional to their number",
    "local features are extracted for shortlisted images alone, divided evenly; no two queries share an image, which "
    "is an upper bound",
    "local features and global descriptor of a query are extracted when it arrives; queries are divided evenly",
    "re-ranking a query takes as long as here, where hardly any candidate is shared, whatever the size of the database",
    "network, waiting for the slowest machine and failures cost nothing",
)


class Step(NamedTuple):
    """Wall-clock seconds, CPU seconds of all threads, and peak resident memory until then in GB."""

    seconds: float
    cpu: float
    peak: float


def run(rounds: int | None, out: Path) -> None:
    """Measure in a temporary folder, and print the steps and the forecast."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="mfvpr-city-") as root:
        measured = measure(DATA, Path(root), rounds or ROUNDS)
    rates = {name: rates_of(DATA, measured, seconds) for name, seconds in EXTRACTING.items()}
    plans = [
        {"features": name, "machines": machines} | forecast(rate, WHOLE, ASKED, CANDIDATES, machines)
        for name, rate in rates.items()
        for machines in MACHINES
    ]
    content = asdict(DATA) | {
        "candidates": CANDIDATES, "memory": MEMORY, "whole": WHOLE, "asked": ASKED, "load_before": load,
        "found": measured | {"steps": {name: step._asdict() for name, step in measured["steps"].items()}},
        "assumed": ASSUMED, "rates": rates, "plans": plans,
    }  # fmt: skip
    title = f"{DATA.queries} queries with {CANDIDATES} candidates among {DATA.title}"
    parts = [_steps_table(DATA, measured), *_remarks(DATA, measured),
             f"{ASKED} queries among {WHOLE} images, forecast from these rates:\n", _plans_table(plans),
             *(f"assumed: {assumption}" for assumption in ASSUMED)]  # fmt: skip
    write_report(out, title, parts, content)


def measure(data: SyntheticSet, root: Path, rounds: int) -> dict[str, Any]:
    """Cost of all steps for all queries: medians after a warm-up, except for the features, which are made once.

    `steps` has a `Step` by name, `reranking` the seconds of its parts. `made` is the number of images whose features
    were made, `written` their bytes on disk. A round reads `rows_read` rows of `read` bytes: just written, so they come
    from the system's cache rather than the disk. `recall` is that of retrieval, its shortlist, and the re-ranking.
    """
    queries = FeatureSet.of([data.query(row) for row in bar("queries", data.queries, range(data.queries))])
    query_vectors, vectors = data.global_descriptors()
    steps: dict[str, Step] = {}

    def shortlist(images: int) -> Shortlist:
        return EXACT.shortlist(query_vectors, vectors[:images], CANDIDATES)

    _, steps["retrieval, half"] = repeat("retrieval, half", rounds, lambda: shortlist(data.images // 2))
    candidates, steps["retrieval"] = repeat("retrieval", rounds, lambda: shortlist(data.images))
    _, steps["merging"] = repeat("merging", rounds, lambda: merge(candidates, max(MACHINES)))
    store, making = make_features(data, root, np.unique(candidates.indices[candidates.mask]))
    source = Counted(store)
    database = FeatureSet(source, {})
    predictions: list[Rankings] = []
    _, reranking = repeat("re-ranking", rounds, lambda: predictions.append(rerank(queries, database, candidates)))
    num_images, written, rows_read = int(store.done.sum()), store.size_bytes, source.rows / len(predictions)
    positives = Positives.from_rows(data.similar(), data.images)
    of_retrieval, of_shortlist = recall_at_k(candidates.indices, positives, [1, CANDIDATES]).tolist()
    [of_reranking] = recall_at_k(predictions[0].rows, positives, [1]).tolist()
    return {
        "steps": steps | making | {"re-ranking": reranking}, "reranking": median_seconds(predictions[1:]),
        "made": num_images, "written": written, "rows_read": rows_read, "read": rows_read * written / num_images,
        "recall": {"retrieval": of_retrieval, "shortlist": of_shortlist, "re-ranking": of_reranking},
    }  # fmt: skip


def measure_step(call: Callable[[], Any]) -> tuple[Any, Step]:
    """Result of a call and its cost."""
    start, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, Step(time.perf_counter() - start, time.process_time() - cpu, peak_bytes() / 1e9)


def repeat(label: str, rounds: int, call: Callable[[], Any]) -> tuple[Any, Step]:
    """Result of a first call, which compiles, and the median cost of `rounds` more."""
    result = call()
    steps = [measure_step(call)[1] for _ in bar(label, rounds, range(rounds))]
    return result, Step(*np.median(steps, axis=0).tolist())


def merge(candidates: Shortlist, machines: int) -> np.ndarray:
    """Positions `[Q, C]` of the best candidates of all machines, which here all find the same ones."""
    return np.asarray(rank(np.tile(candidates.scores, machines)))[:, : candidates.scores.shape[1]]


def make_features(data: SyntheticSet, root: Path, rows: np.ndarray) -> tuple[FeatureStore, dict[str, Step]]:
    """Store the features of some rows of the database below `root`; also the cost of making and of storing them."""
    store = data.open_store(root, "city", data.images)
    require_space(root, forecast_bytes(len(rows), data.keypoints, data.dimension))
    queries, making, storing = data.query_by_row(), [], []
    batches = np.split(rows, range(BATCH, len(rows), BATCH))
    with store:
        for batch in bar("extraction", len(batches), batches):
            features, step = measure_step(
                lambda batch=batch: {row: data.image(row, queries.get(row)) for row in batch.tolist()}
            )
            making.append(step)
            storing.append(measure_step(lambda features=features: store.write(features))[1])
    return store, {"making": _sum(making), "storing": _sum(storing)}


def _sum(steps: list[Step]) -> Step:
    seconds, cpu, peaks = zip(*steps, strict=True)
    return Step(sum(seconds), sum(cpu), max(peaks))


def rates_of(data: SyntheticSet, measured: Mapping[str, Any], extracting: float) -> dict[str, float]:
    """Seconds and bytes on this machine, where the local features of an image take `extracting` seconds."""
    steps = measured["steps"]
    return {
        "describing": DESCRIBING,  # the global descriptor of an image
        "comparing": steps["retrieval"].seconds / (data.queries * data.images),  # a query with a database image
        "merging": steps["merging"].seconds / (data.queries * CANDIDATES * max(MACHINES)),  # a candidate of a machine
        "extracting": extracting,
        "storing": steps["storing"].seconds / measured["made"],  # the local features of an image
        "reranking": steps["re-ranking"].seconds / data.queries,  # all candidates of a query
        "vector_bytes": 4 * GLOBAL,  # a global descriptor in memory
        "row_bytes": measured["written"] / measured["made"],  # the local features of an image on disk
    }


def forecast(rates: Mapping[str, float], images: int, queries: int, candidates: int, machines: int) -> dict[str, float]:
    """Seconds of all queries together, and bytes, on each machine, under the assumptions `ASSUMED`."""
    rows = min(images, queries * candidates)
    merging = rates["merging"] * queries * candidates * machines if machines > 1 else 0.0
    answering = {
        "asking": (rates["describing"] + rates["extracting"]) * queries / machines,
        "retrieving": rates["comparing"] * queries * images / machines + merging,
        "extracting": (rates["extracting"] + rates["storing"]) * rows / machines,
        "reranking": rates["reranking"] * queries / machines,
    }
    return answering | {
        "answering": sum(answering.values()),  # from the queries' images to their rankings
        "describing": rates["describing"] * images / machines,  # the database, once
        "merging": merging,  # included in `retrieving`
        "memory": rates["vector_bytes"] * images / machines,
        "disk": rates["row_bytes"] * rows / machines,
    }


def _steps_table(data: SyntheticSet, measured: Mapping[str, Any]) -> Table:
    images = {"making": measured["made"], "storing": measured["made"], "re-ranking": measured["rows_read"]}
    sizes = {"storing": measured["written"], "re-ranking": measured["read"]}
    lines = [
        [name, f"{step.seconds:.2f}", f"{step.cpu:.2f}", f"{1e3 * step.seconds / data.queries:.1f}",
         f"{images[name]:.0f}" if name in images else "", f"{sizes[name] / 1e6:.0f}" if name in sizes else "",
         f"{step.peak:.2f}"]
        for name, step in measured["steps"].items()
    ]  # fmt: skip
    return Table(["step", "seconds", "CPU s", "ms / query", "images", "MB", "peak GB"], lines)


def _remarks(data: SyntheticSet, measured: Mapping[str, Any]) -> Iterator[str]:
    yield "re-ranking: " + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in measured["reranking"].items())
    recall = measured["recall"]
    yield f"R@1: retrieval {recall['retrieval']:.3f}, re-ranking {recall['re-ranking']:.3f}; " + (
        f"R@{CANDIDATES} of retrieval: {recall['shortlist']:.3f}"
    )
    pairs, share = data.queries * CANDIDATES, 100 * measured["made"] / data.images
    yield f"images in the shortlists: {measured['made']} of {pairs} pairs, {share:.1f} % of all"
    ratio = measured["steps"]["retrieval"].seconds / measured["steps"]["retrieval, half"].seconds
    yield f"retrieval, all / half of the images: {ratio:.2f} times as long"
    yield f"global descriptor: {1e3 * DESCRIBING:g} ms an image (MixVPR one by one, experiments/results.md)"
    yield "local features: " + ", ".join(f"{name} {1e3 * seconds:g} ms" for name, seconds in EXTRACTING.items())


def _plans_table(plans: list[dict]) -> Table:
    columns = {  # header -> name, unit, digits
        "database once, h": ("describing", 3600, 2), "queries, s": ("asking", 1, 2),
        "retrieval, s": ("retrieving", 1, 2),
        "(merging)": ("merging", 1, 2), "extraction, s": ("extracting", 1, 1), "re-ranking, s": ("reranking", 1, 1),
        "in all, s": ("answering", 1, 1), "memory, GB": ("memory", 1e9, 2), "disk, GB": ("disk", 1e9, 2),
    }  # fmt: skip
    lines = [
        [plan["features"], str(plan["machines"])]
        + [f"{plan[name] / unit:.{digits}f}" for name, unit, digits in columns.values()]
        for plan in plans
    ]
    return Table(["features", "machines", *columns], lines)
