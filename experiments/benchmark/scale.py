"""Databases of thousands of images: seconds per query and peak memory, each size in a process of its own."""

import json
import multiprocessing
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.benchmark.made_up import MadeUp
from experiments.console import tell
from mfvpr import HistogramOfShifts, pipeline
from mfvpr.data.files import write_text
from mfvpr.numerics import available_cpus
from mfvpr.report.runs import versions
from mfvpr.report.tables import Table
from mfvpr.sources import FeatureSet, FeatureSource, InMemory
from mfvpr.types import Features

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
    with _folder(stores) as root:
        for data in SETS:
            data.stores(root)
        results = [_in_own_process(data, root, rounds or ROUNDS) for data in SETS]
    report(SETS, results, out)


@contextmanager
def _folder(stores: Path | None) -> Iterator[Path]:
    if stores is not None:
        yield stores
    else:
        with tempfile.TemporaryDirectory(prefix="mfvpr-scale-") as root:
            yield Path(root)


def _in_own_process(data: MadeUp, root: Path, rounds: int) -> Result:
    tell(f"{data.title}: {rounds} rounds of {data.queries} queries")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measure, data, root, rounds, time.monotonic()).result()


def measure(data: MadeUp, root: Path, rounds: int, start: float) -> Result:
    """One size, in the process that calls, which was begun at `start` by `time.monotonic`."""
    query_store, database_store = data.stores(root)
    source, vectors = Counted(database_store), data.global_descriptors()
    queries, database = FeatureSet(query_store, {}), FeatureSet(source, {})
    ranked(FeatureSet.of([queries[0]]), database, (vectors[0][:1], vectors[1]))
    first = time.monotonic() - start
    source.rows, source.seconds = 0, 0.0
    cpu = time.process_time()
    answers = [ranked(queries, database, vectors) for _ in range(rounds)]
    cpu = time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
    per_query, answer = rounds * data.queries, answers[0]
    same = None
    if data.images * data.dimension <= IN_MEMORY * 128:
        whole = FeatureSet(InMemory(dict(database_store.read()), data.images), {})
        expected = ranked(queries, whole, vectors, memory=None)
        same = np.array_equal(answer.rows, expected.rows) and np.array_equal(answer.scores, expected.scores)
    hits = [best in rows for best, rows in zip(answer.rows[:, 0], data.similar(), strict=True)]
    return Result(
        total=[sum(one.seconds.values()) / data.queries for one in answers],
        steps={name: float(np.median([one.seconds[name] for one in answers])) / data.queries for name in STEPS},
        cpu=cpu / per_query,
        reading=source.seconds / per_query,
        rows=source.rows / per_query,
        peak=peak,
        first=first,
        recall=float(np.mean(hits)),
        same=same,
    )


def ranked(
    queries: FeatureSet,
    database: FeatureSet,
    vectors: tuple[np.ndarray, np.ndarray],
    *,
    memory: float | None = MEMORY,
) -> Answer:
    """All steps for all queries; `vectors` are the global descriptors of both sides."""
    times = [time.perf_counter()]
    candidates = pipeline.shortlist(*vectors, CANDIDATES)
    times.append(time.perf_counter())
    matches = pipeline.match(queries, database, candidates, memory=memory)
    times.append(time.perf_counter())
    scores = pipeline.score({"histogram": HistogramOfShifts()}, matches, candidates)["histogram"]
    times.append(time.perf_counter())
    order = pipeline.rank(candidates, scores)
    times.append(time.perf_counter())
    rows = np.take_along_axis(candidates.indices, order, axis=1)
    return Answer(rows, scores, dict(zip(STEPS, np.diff(times).tolist(), strict=True)))


def report(sets: Sequence[MadeUp], results: Sequence[Result], out: Path) -> None:
    """One table, and what it must show."""
    header = ["database", "ms / query", *STEPS, "(reading)", "rows read", "CPU ms", "peak GB", "first answer s", "R@1"]
    lines = [
        [data.title]
        + [f"{1e3 * value:.1f}" for value in (np.median(one.total), *(one.steps[name] for name in STEPS), one.reading)]
        + [f"{one.rows:.1f}", f"{1e3 * one.cpu:.1f}", f"{one.peak:.2f}", f"{one.first:.1f}", f"{100 * one.recall:.0f}"]
        for data, one in zip(sets, results, strict=True)
    ]
    table, remarks = Table(header, lines), list(_remarks(sets, results))
    machine = {"cores": available_cpus(), "processor": platform.machine()}
    setting = {"queries": sets[0].queries, "candidates": CANDIDATES, "keypoints": sets[0].keypoints, "memory": MEMORY}
    rows = [vars(data) | vars(one) for data, one in zip(sets, results, strict=True)]
    content = setting | {"machine": machine, "versions": versions(), "remarks": remarks, "results": rows}
    write_text(out, json.dumps(content, indent=1) + "\n")
    title = f"{setting['queries']} queries with {CANDIDATES} candidates, {MEMORY:g} GB asked for; {machine}"
    print(f"\n{title}\n", table.text(), *remarks, f"results: {out}", sep="\n")


def _remarks(sets: Sequence[MadeUp], results: Sequence[Result]) -> Iterator[str]:
    alike = [one for data, one in zip(sets, results, strict=True) if data.dimension == sets[0].dimension]
    first, last = alike[0], alike[-1]
    yield (
        f"seconds per query, largest / smallest: {np.median(last.total) / np.median(first.total):.2f} "
        f"(CPU {last.cpu / first.cpu:.2f})"
    )
    yield f"peak memory: {max(one.peak for one in results):.2f} GB at most"
    tried = {data.title: one.same for data, one in zip(sets, results, strict=True) if one.same is not None}
    yield "scores and rankings as with all features in memory, bit for bit: " + ", ".join(
        f"{title}: {'yes' if same else 'NO'}" for title, same in tried.items()
    )
