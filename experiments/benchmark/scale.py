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
from experiments.benchmark.synthetic_features import MadeUp
from experiments.console import bar
from mfvpr import HistogramOfShifts
from mfvpr.evaluation import stages
from mfvpr.features import FeatureSet, FeatureSource, InMemory
from mfvpr.report import Table
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.retrieval.search import EXACT
from mfvpr.types import Features, Shortlist

QUERIES, KEYPOINTS = 100, 700
SETS = tuple(
    MadeUp(images, QUERIES, KEYPOINTS, dimension)
    for images, dimension in ((1000, 128), (2000, 128), (4000, 128), (10_000, 128), (4000, 512))
)
CANDIDATES = 50
MEMORY = 3.0  # GB that the evaluation may take
IN_MEMORY = 2000  # images with 128 dimensions that fit into memory, where all features are ranked again for comparison
ROUNDS = 3
STEPS = ("filter", "matching", "scoring", "ranking")


class Answer(NamedTuple):
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
        for data in bar("first queries", len(SETS), SETS):
            pools.append(stack.enter_context(ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))))
            pools[-1].submit(_start, data, root, time.monotonic()).result()
        turns = [pool for _ in range(rounds or ROUNDS) for pool in pools]
        for pool in bar("rounds", len(turns), turns):
            pool.submit(_call, "take_turn").result()
        results = {
            data.title: pool.submit(_call, "measurements").result() for data, pool in zip(SETS, pools, strict=True)
        }
    setting = {"queries": SETS[0].queries, "candidates": CANDIDATES, "keypoints": SETS[0].keypoints, "memory": MEMORY}
    title = f"{setting['queries']} queries with {CANDIDATES} candidates, {MEMORY:g} GB of memory"
    parts = [_table(results), *_remarks(results)]
    write_report(out, title, parts, setting | {"results": [*results.values()]})


_sessions: list["Session"] = []  # the only one of a process that `run` started


def _start(data: MadeUp, root: Path, start: float) -> None:
    _sessions.append(Session(data, root, start))


def _call(method: str) -> Any:
    return getattr(_sessions[0], method)()


class Session:
    """One database in the process that calls, which started at `start` (`time.monotonic`)."""

    def __init__(self, data: MadeUp, root: Path, start: float) -> None:
        """Rank a first query."""
        self.data, self.vectors = data, data.global_descriptors()
        query_store, self.store = data.stores(root)
        self.source, self.queries = Counted(self.store), FeatureSet(query_store, {})
        self.database = FeatureSet(self.source, {})
        rank_queries(FeatureSet.of([self.queries[0]]), self.database, (self.vectors[0][:1], self.vectors[1]))
        self.first = time.monotonic() - start
        self.source.rows, self.source.seconds = 0, 0.0
        self.answers: list[Answer] = []
        self.cpu = 0.0

    def take_turn(self) -> None:
        """Rank all queries."""
        cpu = time.process_time()
        self.answers.append(rank_queries(self.queries, self.database, self.vectors))
        self.cpu += time.process_time() - cpu

    def measurements(self) -> dict[str, Any]:
        """The data set's numbers, and what all turns took; only now are all features of a database in memory.

        Seconds are per query: `total` of each round, medians of the `steps`, `cpu` of all threads, `reading` of the
        thread that reads `rows` while others are matched. `peak` is in GB. `first` is seconds from the start of the
        process to the first ranking. `same` says whether the ranking equals the one with all features in memory, bit
        for bit; None = not compared.
        """
        peak = peak_bytes() / 1e9
        data, first, count = self.data, self.answers[0], len(self.answers) * self.data.queries
        correct = [best in rows for best, rows in zip(first.rows[:, 0], data.similar(), strict=True)]
        medians = median_seconds(self.answers)
        return vars(data) | {
            "total": [sum(answer.seconds.values()) / data.queries for answer in self.answers],
            "steps": {name: medians[name] / data.queries for name in STEPS},
            "cpu": self.cpu / count,
            "reading": self.source.seconds / count,
            "rows": self.source.rows / count,
            "peak": peak,
            "first": self.first,
            "recall": float(np.mean(correct)),
            "same": self._equals_ranking_in_memory() if data.images * data.dimension <= IN_MEMORY * 128 else None,
        }

    def _equals_ranking_in_memory(self) -> bool:
        database = FeatureSet(InMemory(dict(self.store.read()), self.data.images), {})
        expected = rank_queries(self.queries, database, self.vectors, memory=None)
        return all(np.array_equal(*arrays) for arrays in zip(self.answers[0][:2], expected[:2], strict=True))


def peak_bytes() -> int:
    """Peak resident memory of this process; at least its parent's where the system does not tell them apart."""
    status = Path("/proc/self/status")
    kilobytes = re.findall(r"VmHWM: *(\d+)", status.read_text()) if status.exists() else []
    unit = 1 if sys.platform == "darwin" else 1024
    return 1024 * int(kilobytes[0]) if kilobytes else unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def rank_queries(
    queries: FeatureSet, database: FeatureSet, vectors: tuple[np.ndarray, np.ndarray],
    *, memory: float | None = MEMORY,
) -> Answer:  # fmt: skip
    """Retrieve by the global descriptors `vectors` of both sides, and re-rank."""
    start = time.perf_counter()
    candidates = EXACT.shortlist(*vectors, CANDIDATES)
    filtering = {"filter": time.perf_counter() - start}
    answer = rerank(queries, database, candidates, memory=memory)
    return answer._replace(seconds=filtering | answer.seconds)


def rerank(
    queries: FeatureSet, database: FeatureSet, candidates: Shortlist, *, memory: float | None = MEMORY
) -> Answer:
    """Match, score and rank the candidates."""
    times = [time.perf_counter()]
    matches = stages.match(queries, database, candidates, memory=memory)
    times.append(time.perf_counter())
    scores = stages.score({"histogram": HistogramOfShifts()}, matches, candidates)["histogram"]
    times.append(time.perf_counter())
    order = rank_shortlist(candidates, scores)
    times.append(time.perf_counter())
    rows = np.take_along_axis(candidates.indices, order, axis=1)
    return Answer(rows, scores, dict(zip(STEPS[1:], np.diff(times).tolist(), strict=True)))


def median_seconds(answers: list[Answer]) -> dict[str, float]:
    """Medians over the rounds, by step."""
    return {name: float(np.median([answer.seconds[name] for answer in answers])) for name in answers[0].seconds}


def _table(results: dict[str, dict[str, Any]]) -> Table:
    header = ["database", "ms / query", *STEPS, "(reading)", "rows read", "CPU ms", "peak GB", "first answer s", "R@1"]
    lines = []
    for title, result in results.items():
        seconds = [np.median(result["total"]), *result["steps"].values(), result["reading"]]
        lines.append([
            title, *(f"{1e3 * value:.1f}" for value in seconds), f"{result['rows']:.1f}", f"{1e3 * result['cpu']:.1f}",
            f"{result['peak']:.2f}", f"{result['first']:.1f}", f"{100 * result['recall']:.0f}",
        ])  # fmt: skip
    return Table(header, lines)


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
