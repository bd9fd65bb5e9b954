"""Databases of thousands of images: seconds per query and peak memory, each size in a process of its own."""

import json
import multiprocessing
import platform
import re
import resource
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.benchmark.synthetic_features import MadeUp
from experiments.console import bar
from mfvpr import HistogramOfShifts
from mfvpr.evaluation import stages
from mfvpr.features import FeatureSet, FeatureSource, InMemory
from mfvpr.report import Table
from mfvpr.reranking.ranking import rank_shortlist
from mfvpr.retrieval.search import EXACT
from mfvpr.types import Features, Shortlist
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

QUERIES, KEYPOINTS = 100, 700
SETS = tuple(
    MadeUp(images, QUERIES, KEYPOINTS, dimension)
    for images, dimension in ((1000, 128), (2000, 128), (4000, 128), (10_000, 128), (4000, 512))
)
CANDIDATES = 50
MEMORY = 3.0  # GB asked for
IN_MEMORY = 2000  # images, up to which all is ranked again with all features in memory
ROUNDS = 3
STEPS = ("filter", "matching", "scoring", "ranking")


@dataclass(frozen=True)
class Result:
    """What a process measured; seconds are per query.

    Attributes:
        total: of each round.
        steps: medians over the rounds, by step; rows are read while others are matched.
        cpu: of all threads together.
        reading: of the thread that reads.
        rows: read per query.
        peak: GB of resident memory, at most.
        first: seconds from the start of the process to the first query's ranking.
        recall: share of queries of which an image of the same place ranks first.
        same: whether scores and rankings are those with all features in memory, bit for bit; None = not tried.
    """

    total: list[float]
    steps: dict[str, float]
    cpu: float
    reading: float
    rows: float
    peak: float
    first: float
    recall: float
    same: bool | None


class Answer(NamedTuple):
    """Rows of the database `[Q, C]`, best first; the candidates' scores `[Q, C]` in their order; seconds by step."""

    rows: np.ndarray
    scores: np.ndarray
    seconds: dict[str, float]


class Counted:
    """A source that counts the rows that are read of it, and the seconds that this takes."""

    def __init__(self, source: FeatureSource) -> None:
        self._source, self.counts = source, source.counts
        self.rows, self.seconds = 0, 0.0

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Features]]:
        """See `FeatureSource`."""
        start = time.perf_counter()
        for item in self._source.read(rows):
            self.rows, self.seconds = self.rows + 1, self.seconds + time.perf_counter() - start
            yield item
            start = time.perf_counter()


def run(rounds: int | None, out: Path, stores: Path | None = None) -> None:
    """Print a table and write it as JSON to `out`; stores that are made are kept in `stores`, or else deleted."""
    with _folder(stores) as root, ExitStack() as processes:
        for data in SETS:
            data.stores(root)
        pools = []
        for data in bar("first queries", len(SETS), SETS):
            pools.append(processes.enter_context(ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))))
            pools[-1].submit(_begin, data, root, time.monotonic()).result()
        turns = [pool for _ in range(rounds or ROUNDS) for pool in pools]  # so a noisy machine disturbs all alike
        for pool in bar("rounds", len(turns), turns):
            pool.submit(_take_turn).result()
        results = [pool.submit(_end).result() for pool in pools]
    report(SETS, results, out)


@contextmanager
def _folder(stores: Path | None) -> Iterator[Path]:
    if stores is not None:
        yield stores
    else:
        with tempfile.TemporaryDirectory(prefix="mfvpr-scale-") as root:
            yield Path(root)


_session: list["Session"] = []  # of a process that `run` started


def _begin(data: MadeUp, root: Path, start: float) -> None:
    _session.append(Session(data, root, start))


def _take_turn() -> None:
    _session[0].take_turn()


def _end() -> Result:
    return _session[0].result()


class Session:
    """One size, in the process that calls, which was begun at `start` by `time.monotonic`."""

    def __init__(self, data: MadeUp, root: Path, start: float) -> None:
        """Rank a first query."""
        self.data, self.vectors = data, data.global_descriptors()
        query_store, self.store = data.stores(root)
        self.source, self.queries = Counted(self.store), FeatureSet(query_store, {})
        self.database = FeatureSet(self.source, {})
        ranked(FeatureSet.of([self.queries[0]]), self.database, (self.vectors[0][:1], self.vectors[1]))
        self.first = time.monotonic() - start
        self.source.rows, self.source.seconds = 0, 0.0
        self.answers: list[Answer] = []
        self.cpu = 0.0

    def take_turn(self) -> None:
        """Rank all queries."""
        cpu = time.process_time()
        self.answers.append(ranked(self.queries, self.database, self.vectors))
        self.cpu += time.process_time() - cpu

    def result(self) -> Result:
        """Of all turns; only now is anything held in memory as a whole."""
        peak = peak_bytes() / 1e9
        data, answers, per_query = self.data, self.answers, len(self.answers) * self.data.queries
        hits = [best in rows for best, rows in zip(answers[0].rows[:, 0], data.similar(), strict=True)]
        return Result(
            total=[sum(answer.seconds.values()) / data.queries for answer in answers],
            steps={
                name: float(np.median([answer.seconds[name] for answer in answers])) / data.queries for name in STEPS
            },
            cpu=self.cpu / per_query,
            reading=self.source.seconds / per_query,
            rows=self.source.rows / per_query,
            peak=peak,
            first=self.first,
            recall=float(np.mean(hits)),
            same=self._is_as_in_memory() if data.images * data.dimension <= IN_MEMORY * 128 else None,
        )

    def _is_as_in_memory(self) -> bool:
        whole = FeatureSet(InMemory(dict(self.store.read()), self.data.images), {})
        expected, answer = ranked(self.queries, whole, self.vectors, memory=None), self.answers[0]
        return np.array_equal(answer.rows, expected.rows) and np.array_equal(answer.scores, expected.scores)


def peak_bytes() -> int:
    """Resident memory at its most, of this process; where the system keeps no such count, not below its parent's."""
    status = Path("/proc/self/status")
    own = re.findall(r"VmHWM: *(\d+)", status.read_text()) if status.exists() else []
    unit = 1 if sys.platform == "darwin" else 1024
    return 1024 * int(own[0]) if own else unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def ranked(
    queries: FeatureSet,
    database: FeatureSet,
    vectors: tuple[np.ndarray, np.ndarray],
    *,
    memory: float | None = MEMORY,
) -> Answer:
    """All steps for all queries; `vectors` are the global descriptors of both sides."""
    start = time.perf_counter()
    candidates = EXACT.shortlist(*vectors, CANDIDATES)
    filtering = {"filter": time.perf_counter() - start}
    answer = reranked(queries, database, candidates, memory=memory)
    return answer._replace(seconds=filtering | answer.seconds)


def reranked(
    queries: FeatureSet, database: FeatureSet, candidates: Shortlist, *, memory: float | None = MEMORY
) -> Answer:
    """All steps after the filter."""
    times = [time.perf_counter()]
    matches = stages.match(queries, database, candidates, memory=memory)
    times.append(time.perf_counter())
    scores = stages.score({"histogram": HistogramOfShifts()}, matches, candidates)["histogram"]
    times.append(time.perf_counter())
    order = rank_shortlist(candidates, scores)
    times.append(time.perf_counter())
    rows = np.take_along_axis(candidates.indices, order, axis=1)
    return Answer(rows, scores, dict(zip(STEPS[1:], np.diff(times).tolist(), strict=True)))


def report(sets: Sequence[MadeUp], results: Sequence[Result], out: Path) -> None:
    """One table, and what it must show."""
    header = ["database", "ms / query", *STEPS, "(reading)", "rows read", "CPU ms", "peak GB", "first answer s", "R@1"]
    lines = [
        [data.title]
        + [
            f"{1e3 * value:.1f}"
            for value in (np.median(result.total), *(result.steps[name] for name in STEPS), result.reading)
        ]
        + [
            f"{result.rows:.1f}",
            f"{1e3 * result.cpu:.1f}",
            f"{result.peak:.2f}",
            f"{result.first:.1f}",
            f"{100 * result.recall:.0f}",
        ]
        for data, result in zip(sets, results, strict=True)
    ]
    table, remarks = Table(header, lines), list(_remarks(sets, results))
    machine = {"cores": available_cpus(), "processor": platform.machine()}
    setting = {"queries": sets[0].queries, "candidates": CANDIDATES, "keypoints": sets[0].keypoints, "memory": MEMORY}
    rows = [vars(data) | vars(result) for data, result in zip(sets, results, strict=True)]
    content = setting | {"machine": machine, "versions": versions(), "remarks": remarks, "results": rows}
    write_text(out, json.dumps(content, indent=1) + "\n")
    title = f"{setting['queries']} queries with {CANDIDATES} candidates, {MEMORY:g} GB asked for; {machine}"
    print(f"\n{title}\n", table.text(), *remarks, f"results: {out}", sep="\n")


def _remarks(sets: Sequence[MadeUp], results: Sequence[Result]) -> Iterator[str]:
    alike = [result for data, result in zip(sets, results, strict=True) if data.dimension == sets[0].dimension]
    first, last = alike[0], alike[-1]
    yield "seconds per query, largest / smallest: " + ", ".join(
        f"{name} {of(last) / of(first):.2f}"
        for name, of in (
            ("median", lambda result: np.median(result.total)),
            ("fastest round", lambda result: min(result.total)),
            ("CPU", lambda result: result.cpu),
        )
    )
    yield f"peak memory: {max(result.peak for result in results):.2f} GB at most"
    tried = {data.title: result.same for data, result in zip(sets, results, strict=True) if result.same is not None}
    yield "scores and rankings as with all features in memory, bit for bit: " + ", ".join(
        f"{title}: {'yes' if same else 'NO'}" for title, same in tried.items()
    )
