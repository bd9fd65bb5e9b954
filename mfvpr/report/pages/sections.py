"""What pages are made of, and the parts of one that show a run."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import MEANS
from mfvpr.evaluation.precision import PrecisionRecall
from mfvpr.evaluation.statistics import recall_interval
from mfvpr.report.pages.charts import Bar, Chart, amounts, bars, lines
from mfvpr.report.pages.files import Answer, Gains, Run
from mfvpr.report.pages.pictures import Picture, pictures
from mfvpr.report.tables import Table
from mfvpr.reranking.results import FILTER

MOST_ANSWERS = 5000  # rows of a table that a browser still sorts at once
_P_VALUES = ("McNemar p", "p by blocks")
PRECISION_AXES = "recall of queries with an answer, %", "precision, %"
_MOST_POINTS = 200  # of a curve
_DIFFERENCES = ("system", "other", "only system", "only other", "McNemar p", "queries in a block", "blocks",
                "p by blocks")  # fmt: skip


@dataclass(frozen=True)
class Sheet:
    """A table of a page, and what it is called."""

    caption: str
    table: Table


@dataclass(frozen=True)
class Gallery:
    """Answers to queries, which can be filtered; `left_out` = how many there are beyond `MOST_ANSWERS`."""

    system: str
    systems: Sequence[str]
    sequences: Sequence[str]
    pictures: Sequence[Picture]
    answers: Sequence[Answer]
    left_out: int

    @property
    def outcomes(self) -> list[str]:
        """That there are."""
        return sorted({one.outcome for one in (*self.pictures, *self.answers)})


@dataclass(frozen=True)
class Section:
    """A part of a page, with a word as the name of its element; `words` stand above everything in it.

    `links` are words and the addresses of other pages, from where this one is.
    """

    name: str
    title: str
    words: str = ""
    charts: Sequence[Chart] = ()
    sheets: Sequence[Sheet] = ()
    gallery: Gallery | None = None
    links: Sequence[tuple[str, str]] = ()


def recall_section(run: Run) -> Section:
    """Recall with intervals, over tolerances and over K; with ground truth."""
    charts = [bars("intervals", f"Recall at 1{run.within}, with intervals", _intervals(run), axis="recall at 1, %")]
    if len(run.thresholds) > 1:
        axes = f"tolerance, {run.unit}", f"recall at {run.first_k}, %"
        charts.append(lines("tolerances", "Recall over tolerance", recall_by_tolerance(run), axes=axes, marked=True))
    curves = {name: recall_by_depth(run.all_gains, name, run.common["candidates"]) for name in run.systems}
    axes = "K, the first candidates", "recall at K, %"
    charts.append(lines("depths", f"Recall over K{run.within}", curves, axes=axes, scale="log"))
    words = f"In %. Everything told of single queries is what is right at the middle tolerance{run.within}. Intervals "
    words += "are 95 % and know that neighbors along the path fail together."
    found = run.table("table.csv")
    sheets = [] if found is None else [Sheet("Recall of every system", _with_intervals(run, found))]
    return Section("recall", "Recall", words, charts, sheets)


def interval(gains: Gains, system: str) -> tuple[float, float]:
    """Of recall at 1, in %."""
    low, high = recall_interval(gains.hits(system))
    return 100 * low, 100 * high


def recall_by_depth(gains: Gains, system: str, candidates: int) -> list[tuple[float, float]]:
    """(K, recall at K in %) from 1 to all candidates, at all small Ks and some larger ones."""
    depths = np.unique(np.geomspace(1, max(candidates, 1), _MOST_POINTS).round().astype(int)).tolist()
    return [(k, 100 * float(gains.hits(system, k).mean())) for k in depths]


def differences_section(run: Run) -> Section | None:
    """Every two systems; None without ground truth, or with one system alone."""
    found = run.table("differences.csv", 2)
    if found is None or not found.rows:
        return None
    words = "How many queries only one of two systems gets right, and how probable that is if neither is better: by "
    words += "McNemar's exact test, which takes queries for independent, and by blocks of neighbors along the path."
    probabilities = [place for place, name in enumerate(_DIFFERENCES) if name in _P_VALUES]
    rows = [
        [f"{float(cell):.2g}" if place in probabilities else cell for place, cell in enumerate(row)]
        for row in found.rows
    ]
    sheet = Sheet("Every two systems", Table(_DIFFERENCES, rows, 2))
    return Section("differences", "Differences", words, sheets=[sheet])


def confidence_section(run: Run) -> Section | None:
    """Precision against recall, and what re-ranking the unsure queries gives; None without ground truth."""
    if run.table("precision_recall.csv") is None:
        return None
    table, shares = map(run.table, ("confidence.csv", "rerank_share.csv"))
    charts = []
    for by, words in (("score", "by the score"), ("p", "by p(right)")):
        if curves := precision_by_recall(run, {name: name for name in run.systems}, by):
            title = f"Precision and recall {words}"
            charts.append(lines(f"precision-{by}", title, curves, axes=PRECISION_AXES, scale="percent"))
    if shares is not None and shares.rows and len(shares.header) > 1:
        axes, title = ("queries re-ranked, %", "recall at 1, %"), "Re-ranking only what the filter is unsure of"
        charts.append(lines("shares", title, _by_share(shares), axes=axes, scale="percent"))
    sheets = [] if table is None or not table.rows else [Sheet("Confidence of first answers, in %", table)]
    words = "AP is the average precision, R@100P the recall at 100 % precision, ECE the expected calibration error of "
    return Section("confidence", "Precision and recall", f"{words}p(right).", charts, sheets)


def costs_section(run: Run) -> Section:
    """Seconds and sizes."""
    seconds, common = run.common["seconds"], run.common
    rows = [[stage, f"{value:.3f}", f"{value / max(common['queries'], 1):.4f}"] for stage, value in seconds.items()]
    sizes = [["queries", f"{common['queries']}"], ["database images", f"{common['database']}"],
             ["candidates of a query", f"{common['candidates']}"]]  # fmt: skip
    if common["bytes_per_image"] is not None:
        sizes.append(["bytes on disk of an image's features, about", f"{common['bytes_per_image']}"])
    chart = amounts("seconds", "Seconds by stage", seconds, axis="seconds")
    sheets = [Sheet("Seconds", Table(["stage", "seconds", "per query"], rows)),
              Sheet("Sizes", Table(["what", "number"], sizes))]  # fmt: skip
    words = "What was in the stores already was not computed again."
    return Section("costs", "Seconds and sizes", words, [chart], sheets)


def answers_section(run: Run) -> Section:
    """The first answers, with pictures of some."""
    total = len(run.systems) * len(run.all_gains.queries) if run.gains else 0
    answers = [*islice(run.answers(), MOST_ANSWERS)]
    gallery = Gallery(
        run.headline, run.systems, run.sequences, pictures(run.folder), answers, max(0, total - len(answers))
    )
    words = "Query and first answer with their heaviest matches, and the histogram of their shifts; below a wrong "
    words += "answer the right one. The table has the queries without a picture, too."
    return Section("answers", "Answers", words, gallery=gallery)


def settings_section(run: Run) -> Section:
    """What made the results."""
    about = {name: run.about.get(name) for name in ("command", "commit")} | {
        "ground truth": run.common["ground_truth"], "data fingerprint": run.common["data_fingerprint"]
    }  # fmt: skip
    sheets = [
        Sheet(caption, Table(["name", "value"], [*map(list, flat(values))], text_columns=2))
        for caption, values in (
            ("Run", about), ("Settings", run.about["settings"]), ("Versions", run.common["versions"]),
            ("Systems", {row["system"]: row["parameters"] for row in run.results}),
        )
    ]  # fmt: skip
    skipped = run.table("skipped.csv", 3)
    sheets += [] if skipped is None else [Sheet("Images that could not be used", skipped)]
    return Section("settings", "Settings and versions", sheets=sheets)


def flat(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Nested values as (dotted name, text)."""
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from ((f"{name}.{inner}", text) for inner, text in flat(value))
        else:
            yield name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def percent(low_high: tuple[float, float]) -> str:
    """An interval in a cell."""
    return "[{:.1f}, {:.1f}]".format(*low_high)


def _intervals(run: Run) -> dict[str, dict[str, Bar]]:
    """By system and sequence, those of several and all of them; of one sequence by system alone."""
    parts = {**run.gains, MEANS[-1]: run.all_gains} if len(run.gains) > 1 else {"": run.all_gains}
    found = {
        system: {name: Bar(100 * float(gains.hits(system).mean()), interval(gains, system))
                 for name, gains in parts.items()}
        for system in run.systems
    }  # fmt: skip
    return found if len(parts) > 1 else {"recall": {system: one[""] for system, one in found.items()}}


def _with_intervals(run: Run, table: Table) -> Table:
    several = len(run.sequences) > 1
    parts = {**run.gains, MEANS[-1]: run.all_gains} if several else {}
    rows = []
    for row in table.rows:
        gains = parts.get(row[1]) if several else run.all_gains
        rows.append([*row, "" if gains is None else percent(interval(gains, row[0]))])
    return Table([*table.header, f"R@1{run.within}, 95 %"], rows, 1 + several)


def recall_by_tolerance(run: Run) -> dict[str, list[tuple[float, float]]]:
    """(threshold, recall at `Run.first_k` in %) by system, of all queries."""
    rows = [row for row in run.results if row.get("sequence", MEANS[-1]) == MEANS[-1]]
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in run.systems}
    for row in rows:
        threshold = next(row[name] for name in ("tolerance", "radius") if name in row)
        found[row["system"]].append((threshold, 100 * row["recall_at"][run.first_k]))
    return found


def _by_share(shares: Table) -> dict[str, list[tuple[float, float]]]:
    """(share of the queries re-ranked, recall) in % by system, and the filter's own recall beside them."""
    share, *recall = [list(map(float, column)) for column in zip(*shares.rows, strict=True)]
    curves = {FILTER: [(0.0, recall[0][0]), (100.0, recall[0][0])]}
    for name, column in zip(shares.header[1:], recall, strict=True):
        curves[name] = [(100 * x, y) for x, y in zip(share, column, strict=True)]
    return curves


def precision_by_recall(run: Run, names: Mapping[str, str], by: str = "score") -> dict[str, list[tuple[float, float]]]:
    """(recall, precision) in % by the names of some systems, to which their average precision is added."""
    points, curves = run.table("precision_recall.csv"), {}
    known = [] if points is None else points.rows
    for system, name in names.items():
        rows = [[float(cell) for cell in row[2:]] for row in known if (row[0], row[1]) == (system, by)]
        if rows:
            curve = PrecisionRecall(*np.array(rows).T)
            some = np.unique(np.linspace(0, len(rows) - 1, _MOST_POINTS).round().astype(int))
            label = f"{name}: AP {100 * curve.average_precision:.1f}"
            shown = zip(curve.recall[some], curve.precision[some], strict=True)
            curves[label] = [(round(100 * x, 3), round(100 * y, 3)) for x, y in shown]
    return curves
