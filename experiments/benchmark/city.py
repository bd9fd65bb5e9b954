"""A city of 100,000 images: filter, features of the shortlists alone, re-ranking; and what 2.8 million would take."""

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from experiments.benchmark.projection import ASSUMED, Plan, Rates, projected
from experiments.benchmark.scale import CANDIDATES, MEMORY, Answer, Counted, peak_bytes, reranked
from experiments.benchmark.synthetic_features import BATCH, GLOBAL, MadeUp
from experiments.console import bar
from mfvpr.datasets import Positives
from mfvpr.evaluation import recall_at_k
from mfvpr.features import FeatureSet
from mfvpr.report import Table
from mfvpr.reranking import rank
from mfvpr.retrieval.search import EXACT
from mfvpr.storage.features import FeatureStore, forecast_bytes, open_store, require_space
from mfvpr.storage.manifest import store_path
from mfvpr.types import Shortlist
from mfvpr.utils.files import write_text
from mfvpr.utils.numerics import available_cpus
from mfvpr.utils.versions import versions

DATA = MadeUp(100_000, 200, 700, 128, views=1, likeness=0.18)  # so the filter often fails
ROUNDS = 3
WHOLE, ASKED, MACHINES = 2_800_000, 1000, (1, 8, 64)  # images of San Francisco XL, and what is asked of them
# Seconds of an image on 2 cores, from experiments/results.md: MixVPR one by one (its networks), and the features alone
# of maps that are asked.
DESCRIBING, EXTRACTING = 0.102, {"SIFT": 0.021, "ALIKED n16": 0.070}

Result = TypeVar("Result")


class Step(NamedTuple):
    """Seconds by the clock, seconds of all threads together, and GB of resident memory at most until then."""

    seconds: float
    cpu: float
    peak: float


@dataclass(frozen=True)
class Found:
    """What was measured.

    Attributes:
        steps: by name; medians where they were repeated.
        reranking: seconds of its parts.
        made: images whose features were made.
        written: bytes that their features take on disk.
        rows_read: in a round.
        read: bytes of these, just written: from the system's cache rather than the disk.
        recall: of the filter, of its whole shortlist, and of the re-ranking.
    """

    steps: dict[str, Step]
    reranking: dict[str, float]
    made: int
    written: int
    rows_read: float
    read: float
    recall: dict[str, float]


def run(rounds: int | None, out: Path) -> None:
    """Print tables and write them as JSON to `out`; the features that are made are deleted."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="mfvpr-city-") as root:
        found = walked(DATA, Path(root), rounds or ROUNDS)
    report(DATA, found, load, out)


def walked(data: MadeUp, root: Path, rounds: int) -> Found:
    """All steps for all queries, each once before it is timed, but for the features, which are made once."""
    queries = FeatureSet.of([data.query(row) for row in bar("queries", data.queries, range(data.queries))])
    asked, known = data.global_descriptors()
    steps: dict[str, Step] = {}
    half = known[: data.images // 2]
    _, steps["filter, half"] = repeated("filter, half", rounds, lambda: EXACT.shortlist(asked, half, CANDIDATES))
    candidates, steps["filter"] = repeated("filter", rounds, lambda: EXACT.shortlist(asked, known, CANDIDATES))
    _, steps["merging"] = repeated("merging", rounds, lambda: merged(candidates, max(MACHINES)))
    store, making = extracted(data, root, np.unique(candidates.indices[candidates.mask]))
    source = Counted(store)
    database = FeatureSet(source, {})
    answers: list[Answer] = []
    _, steps["re-ranking"] = repeated(
        "re-ranking", rounds, lambda: answers.append(reranked(queries, database, candidates))
    )
    made, written, rows_read = int(store.done.sum()), store.size_bytes, source.rows / len(answers)
    right = Positives.from_rows(data.similar(), data.images)
    depths = recall_at_k(candidates.indices, right, [1, CANDIDATES]).tolist()
    return Found(
        steps=steps | making,
        reranking={
            name: float(np.median([answer.seconds[name] for answer in answers[1:]])) for name in answers[0].seconds
        },
        made=made,
        written=written,
        rows_read=rows_read,
        read=rows_read * written / made,
        recall={
            "filter": depths[0],
            "shortlist": depths[1],
            "re-ranking": float(recall_at_k(answers[0].rows, right, [1])[0]),
        },
    )


def timed(call: Callable[[], Result]) -> tuple[Result, Step]:
    """What a call gives, and what it takes."""
    start, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, Step(time.perf_counter() - start, time.process_time() - cpu, peak_bytes() / 1e9)


def repeated(label: str, rounds: int, call: Callable[[], Result]) -> tuple[Result, Step]:
    """What a call gives, and the medians of what it takes after a first one, which compiles."""
    result = call()
    steps = [timed(call)[1] for _ in bar(label, rounds, range(rounds))]
    return result, Step(*np.median(steps, axis=0).tolist())


def merged(candidates: Shortlist, machines: int) -> np.ndarray:
    """`[Q, C]` places of the best among as many machines' candidates, here the same ones."""
    return np.asarray(rank(np.tile(candidates.scores, machines)))[:, : candidates.scores.shape[1]]


def extracted(data: MadeUp, root: Path, rows: np.ndarray) -> tuple[FeatureStore, dict[str, Step]]:
    """A store below `root` of all images, in which there are those of some rows; and what making and storing takes."""
    recipe = {"made_up": "city"} | asdict(data)
    store = open_store(store_path(root, "city", recipe), recipe, num_images=data.images)
    require_space(root, forecast_bytes(len(rows), data.keypoints, data.dimension))
    shown, made, stored = data.shown(), [], []
    parts = np.split(rows, range(BATCH, len(rows), BATCH))
    with store:
        for part in bar("extraction", len(parts), parts):
            features, step = timed(lambda part=part: {row: data.image(row, shown.get(row)) for row in part.tolist()})
            made.append(step)
            stored.append(timed(lambda features=features: store.write(features))[1])
    return store, {"making": _sum(made), "storing": _sum(stored)}


def _sum(steps: list[Step]) -> Step:
    seconds, cpu, peaks = zip(*steps, strict=True)
    return Step(sum(seconds), sum(cpu), max(peaks))


def rates(data: MadeUp, found: Found, extracting: float) -> Rates:
    """What one machine takes, where an image's local features take `extracting` seconds."""
    return Rates(
        describing=DESCRIBING,
        comparing=found.steps["filter"].seconds / (data.queries * data.images),
        merging=found.steps["merging"].seconds / (data.queries * CANDIDATES * max(MACHINES)),
        extracting=extracting,
        storing=found.steps["storing"].seconds / found.made,
        reranking=found.steps["re-ranking"].seconds / data.queries,
        vector_bytes=4 * GLOBAL,
        row_bytes=found.written / found.made,
    )


def report(data: MadeUp, found: Found, load: float, out: Path) -> None:
    """Print what was measured and what follows from it, and write both."""
    machine = {"cores": available_cpus(), "processor": platform.machine(), "load_before": load}
    setting = asdict(data) | {"candidates": CANDIDATES, "memory": MEMORY, "whole": WHOLE, "asked": ASKED}
    remarks = list(_remarks(data, found))
    measured = {name: rates(data, found, seconds) for name, seconds in EXTRACTING.items()}
    plans = {
        name: {machines: projected(one, WHOLE, ASKED, CANDIDATES, machines) for machines in MACHINES}
        for name, one in measured.items()
    }
    content = setting | {
        "machine": machine,
        "versions": versions(),
        "remarks": remarks,
        "found": asdict(found) | {"steps": {name: step._asdict() for name, step in found.steps.items()}},
        "assumed": ASSUMED,
        "rates": {name: asdict(one) for name, one in measured.items()},
        "plans": [
            {"features": name, "machines": machines, "answering": plan.answering} | asdict(plan)
            for name, by_machines in plans.items()
            for machines, plan in by_machines.items()
        ],
    }
    write_text(out, json.dumps(content, indent=1) + "\n")
    title = f"{data.queries} queries with {CANDIDATES} candidates among {data.title}; {machine}"
    print(f"\n{title}\n", _steps(data, found).text(), *remarks, sep="\n")
    print(f"\n{ASKED} queries among {WHOLE} images, computed from these\n", _plans(plans).text(), sep="\n")
    print("Assumed:", *(f"- {one}" for one in [*ASSUMED, *_constants()]), f"results: {out}", sep="\n")


def _steps(data: MadeUp, found: Found) -> Table:
    header = ["step", "seconds", "CPU s", "ms / query", "images", "MB", "peak GB"]
    of_rows = {"making": (found.made, None), "storing": (found.made, found.written),
               "re-ranking": (found.rows_read, found.read)}  # fmt: skip
    lines = []
    for name in ("filter, half", "filter", "merging", "making", "storing", "re-ranking"):
        step, (images, size) = found.steps[name], of_rows.get(name, (None, None))
        lines.append([name, f"{step.seconds:.2f}", f"{step.cpu:.2f}", f"{1e3 * step.seconds / data.queries:.1f}",
                      "" if images is None else f"{images:.0f}", "" if size is None else f"{size / 1e6:.0f}",
                      f"{step.peak:.2f}"])  # fmt: skip
    return Table(header, lines)


def _remarks(data: MadeUp, found: Found) -> Iterator[str]:
    parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in found.reranking.items())
    yield f"re-ranking: {parts}"
    recall = found.recall
    yield f"R@1: filter {recall['filter']:.3f}, re-ranking {recall['re-ranking']:.3f}; " + (
        f"R@{CANDIDATES} of the filter: {recall['shortlist']:.3f}"
    )
    pairs = data.queries * CANDIDATES
    yield f"images in the shortlists: {found.made} of {pairs} pairs, {100 * found.made / data.images:.1f} % of all"
    double = found.steps["filter"].seconds / found.steps["filter, half"].seconds
    yield f"filter, all / half of the images: {double:.2f} times as long"


def _constants() -> Iterator[str]:
    yield f"global descriptor: {1e3 * DESCRIBING:g} ms an image (MixVPR one by one, experiments/results.md)"
    yield "local features: " + ", ".join(f"{name} {1e3 * one:g} ms" for name, one in EXTRACTING.items()) + " an image"


def _plans(plans: dict[str, dict[int, Plan]]) -> Table:
    header = ["features", "machines", "database once, h", "queries, s", "filter, s", "(merging)", "extraction, s",
              "re-ranking, s", "in all, s", "memory, GB", "disk, GB"]  # fmt: skip
    lines = [
        [name, str(machines), f"{plan.describing / 3600:.2f}"]
        + [f"{seconds:.2f}" for seconds in (plan.asking, plan.filtering, plan.merging)]
        + [f"{seconds:.1f}" for seconds in (plan.extracting, plan.reranking, plan.answering)]
        + [f"{plan.memory / 1e9:.2f}", f"{plan.disk / 1e9:.2f}"]
        for name, by_machines in plans.items()
        for machines, plan in by_machines.items()
    ]
    return Table(header, lines)
