"""Time per query and peak memory among thousands of images on disk, each database in a process of its own."""

import multiprocessing
import re
import resource
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.benchmark.harness import write_report
from experiments.benchmark.synthetic_features import SyntheticSet
from mfvpr import HistogramOfShifts
from mfvpr.cli.console import Progress
from mfvpr.evaluation import stages
from mfvpr.features import FeatureSet, FeatureSource, InMemory
from mfvpr.report import Table
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.retrieval.search import EXACT
from mfvpr.types import Features
from mfvpr.utils import Runtime

QUERIES, KEYPOINTS = 100, 700
SETS = tuple(
    SyntheticSet(images, QUERIES, KEYPOINTS, dimension)
    for images, dimension in ((1000, 128), (2000, 128), (4000, 128), (10_000, 128), (4000, 512))
)
CANDIDATES = 50
MEMORY = 3.0  # GB that the evaluation may take
IN_MEMORY = 2000  # images with 128 dimensions that fit into memory, where all features are ranked again for comparison
ROUNDS = 3
STEPS = ("retrieval", "matching", "scoring", "ranking")


class Rankings(NamedTuple):
    """Ranking of all queries: database rows and their shortlist's scores `[Q, C]`, and seconds by step."""

    rows: np.ndarray
    scores: np.ndarray
    seconds: dict[str, float]


class Counted:
    """A source that counts the rows that are read from it and the seconds that reading takes."""

    def __init__(self, source: FeatureSource) -> None:
        self._source, self.counts = source, source.counts
        self.rows, self.seconds = 0, 0.0

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """See `FeatureSource`."""
        start = time.perf_counter()
        for row_and_features in self._source.read(rows):
            self.rows, self.seconds = self.rows + 1, self.seconds + time.perf_counter() - start
            yield row_and_features
            start = time.perf_counter()


def run(rounds: int | None, out: Path, stores: Path | None = None) -> None:
    """Measure all databases in turns; their features are kept in `stores`, or deleted if it is None."""
    with ExitStack() as stack:
        root = stores or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mfvpr-scale-")))
        for data in SETS:
            data.stores(root)
        pools = []
        for data in Progress("first queries", len(SETS), SETS):
            pools.append(stack.enter_context(ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))))
            pools[-1].submit(_next_turn, data, root, rounds or ROUNDS, time.monotonic()).result()
        turns = [pool for _ in range(rounds or ROUNDS) for pool in pools]
        for pool in Progress("rounds", len(turns), turns):
            pool.submit(_next_turn).result()
        results = {data.title: pool.submit(_next_turn).result() for data, pool in zip(SETS, pools, strict=True)}
    setting = {"queries": SETS[0].queries, "candidates": CANDIDATES, "keypoints": SETS[0].keypoints, "memory": MEMORY}
    title = f"{setting['queries']} queries with {CANDIDATES} candidates, {MEMORY:g} GB of memory"
    parts = [_table(results), *_remarks(results)]
    write_report(out, title, parts, setting | {"results": [*results.values()]})


_measurements: list[Iterator[Any]] = []  # the only one of a process that `run` started


def _next_turn(*arguments: Any) -> Any:
    """Go on to the next `yield` of the measurement of this process; the first turn has its arguments."""
    if arguments:
        _measurements.append(_measure(*arguments))
    return next(_measurements[0])


def _measure(data: SyntheticSet, root: Path, rounds: int, start: float) -> Iterator[dict[str, Any] | None]:
    """Rank a first query, rank all queries in each round, and yield the numbers of the process that began at `start`.

    Seconds are per query: `total` of each round, medians of the `steps`, `cpu` of all threads, `reading` of the thread
    that reads `rows` while others are matched. `peak` is in GB. `first` is seconds from the start of the process to the
    first ranking. `same` says whether the ranking equals the one with all features in memory, bit for bit; None = not
    compared. Only then are all features in memory.
    """
    vectors, (query_store, store) = data.global_descriptors(), data.stores(root)
    source, queries = Counted(store), FeatureSet(query_store, {})
    database = FeatureSet(source, {})
    rank_queries(FeatureSet.of([queries[0]]), database, (vectors[0][:1], vectors[1]))
    first, source.rows, source.seconds = time.monotonic() - start, 0, 0.0
    predictions, cpu = list[Rankings](), 0.0
    yield None
    for _ in range(rounds):
        before = time.process_time()
        predictions.append(rank_queries(queries, database, vectors))
        cpu += time.process_time() - before
        yield None
    peak, same = peak_bytes() / 1e9, None
    if data.images * data.dimension <= IN_MEMORY * 128:
        in_memory = FeatureSet(InMemory(dict(store.read()), data.images), {})
        expected = rank_queries(queries, in_memory, vectors, memory=None)
        same = all(np.array_equal(*arrays) for arrays in zip(predictions[0][:2], expected[:2], strict=True))
    correct = [best in rows for best, rows in zip(predictions[0].rows[:, 0], data.similar(), strict=True)]
    count = len(predictions) * data.queries
    yield vars(data) | {
        "total": [sum(prediction.seconds.values()) / data.queries for prediction in predictions],
        "steps": {
            step: float(np.median([prediction.seconds[step] for prediction in predictions])) / data.queries
            for step in STEPS
        },
        "cpu": cpu / count,
        "reading": source.seconds / count,
        "rows": source.rows / count,
        "peak": peak,
        "first": first,
        "recall": float(np.mean(correct)),
        "same": same,
    }


def peak_bytes() -> int:
    """Peak resident memory of this process; at least its parent's where the system does not tell them apart."""
    status = Path("/proc/self/status")
    kilobytes = re.findall(r"VmHWM: *(\d+)", status.read_text()) if status.exists() else []
    unit = 1 if sys.platform == "darwin" else 1024
    return 1024 * int(kilobytes[0]) if kilobytes else unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def rank_queries(
    queries: FeatureSet, database: FeatureSet, vectors: tuple[np.ndarray, np.ndarray],
    *, memory: float | None = MEMORY,
) -> Rankings:  # fmt: skip
    """Retrieve by the global descriptors `vectors` of both sides, match, score and rank."""
    times = [time.perf_counter()]
    candidates = EXACT.shortlist(*vectors, CANDIDATES)
    times.append(time.perf_counter())
    matches = stages.match(queries, database, candidates, runtime=Runtime(memory=memory))
    times.append(time.perf_counter())
    scores = stages.score({"histogram": HistogramOfShifts()}, matches, candidates)["histogram"]
    times.append(time.perf_counter())
    order = rank_shortlist(candidates, scores)
    times.append(time.perf_counter())
    rows = np.take_along_axis(candidates.indices, order, axis=1)
    return Rankings(rows, scores, dict(zip(STEPS, np.diff(times).tolist(), strict=True)))


def _table(results: dict[str, dict[str, Any]]) -> Table:
    columns = ["database", "ms / query", *STEPS, "(reading)", "rows read", "CPU ms", "peak GB", "first query s", "R@1"]
    lines = []
    for title, result in results.items():
        seconds = [np.median(result["total"]), *result["steps"].values(), result["reading"]]
        lines.append([
            title, *(f"{1e3 * value:.1f}" for value in seconds), f"{result['rows']:.1f}", f"{1e3 * result['cpu']:.1f}",
            f"{result['peak']:.2f}", f"{result['first']:.1f}", f"{100 * result['recall']:.0f}",
        ])  # fmt: skip
    return Table(columns, lines)


def _remarks(results: dict[str, dict[str, Any]]) -> Iterator[str]:
    alike = [result for result in results.values() if result["dimension"] == SETS[0].dimension]
    first, last = alike[0], alike[-1]
    ratios = {
        "median": np.median(last["total"]) / np.median(first["total"]),
        "fastest round": min(last["total"]) / min(first["total"]),
        "CPU": last["cpu"] / first["cpu"],
    }
    text = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    yield f"seconds per query, largest / smallest: {text}"
    yield f"peak memory: {max(result['peak'] for result in results.values()):.2f} GB at most"
    same = {title: result["same"] for title, result in results.items() if result["same"] is not None}
    text = ", ".join(f"{title}: {'yes' if equal else 'NO'}" for title, equal in same.items())
    yield f"scores and rankings as with all features in memory, bit for bit: {text}"
