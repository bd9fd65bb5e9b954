"""The paper's tables: numbers of the evaluations at hand beside the printed ones, and averages of both."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from experiments.paper.systems import Row
from mfvpr.datasets import Dataset
from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle
from mfvpr.datasets.published import published_differences
from mfvpr.report import Table

BERLIN = ("berlin_a100", "berlin_kudamm", "berlin_halenseestrasse")
OTHERS = ("gardens_point", "nordland_1415", "robotcar_seasons")
INCOMPLETE = " (incomplete)"
OVERALL = ""  # in place of a sequence: the only one, or the plain mean of several
TOLERANCES = (1, 2, 5)  # of the printed recalls
_NONE = "-"
_BEST = ("mix_hist_50", "aliked_hist_50", "sift_hist_50")


@dataclass(frozen=True)
class RowResult:
    """The result of a row's ranking on a data set: recall in % by sequence (`OVERALL` for all), threshold and depth.

    `about` are settings, from the results. `candidates` is a setting, of which a small database has fewer.
    """

    recall: Mapping[str, Mapping[float, Mapping[int, float]]]
    about: Mapping[str, Any]
    candidates: int | str | None = None


@dataclass(frozen=True)
class Evaluations:
    """All evaluations at hand.

    Attributes:
        rows: of the tables.
        datasets: at hand, by name.
        results: by row and data set.
        seconds: of a query, by row and step; see `runs.measure_query`.
        sizes: by row and data set: MiB of the database's features in float32, as the paper counts them.
        timed_on: the data set and the device of the seconds, in words.
        folders: run folders by data set and evaluation.
    """

    rows: Sequence[Row]
    datasets: Mapping[str, Dataset]
    results: Mapping[tuple[str, str], RowResult]
    seconds: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sizes: Mapping[tuple[str, str], float] = field(default_factory=dict)
    timed_on: str = ""
    folders: Mapping[tuple[str, str], Path] = field(default_factory=dict)

    @property
    def best_rows(self) -> list[Row]:
        """Rows whose histograms and failures are shown, the most important first."""
        return [row for name in _BEST for row in self.rows if row.name == name]

    def title(self, name: str) -> str:
        """A data set's name, marked if it lacks images."""
        return name + INCOMPLETE * any(published_differences(self.datasets[name]))

    @cached_property
    def means(self) -> tuple[list[str], dict[str, Float[np.ndarray, " tolerances"]]]:
        """Data sets, and by row the mean recall over them.

        They are the paper's six, averaged as in the paper, if all six are here; else all with the paper's tolerances.
        Rows that lack one have no mean.
        """
        names = [name for name in self.datasets if {*TOLERANCES} <= {*self.thresholds(name)}]
        six = [name for name in names if name in (*BERLIN, *OTHERS)]
        names = six if len(six) == len(BERLIN) + len(OTHERS) else names
        means = {}
        for row in self.rows:
            recalls = {}
            for name in names:
                if result := self.results.get((row.name, name)):
                    recalls[name] = [result.recall[OVERALL][tolerance][1] for tolerance in TOLERANCES]
            if names and len(recalls) == len(names):
                macro = average(recalls) if names == six else None
                means[row.name] = np.mean([*recalls.values()], axis=0) if macro is None else macro
        return names, means

    @property
    def averaged(self) -> str:
        """The data sets of the means, in words."""
        return ", ".join(map(self.title, self.means[0])) or "none"

    def thresholds(self, dataset: str) -> list[float]:
        """Thresholds of a data set's evaluations."""
        recalls = (result.recall[OVERALL] for (_, name), result in self.results.items() if name == dataset)
        return sorted(next(recalls, {}))


@cache
def printed_tables() -> Mapping[str, Any]:
    """Tables by their names in printed.yaml, which describes them."""
    return yaml.safe_load((Path(__file__).parent / "printed.yaml").read_text(encoding="utf-8"))


def average(recalls: Mapping[str, Sequence[float]]) -> Float[np.ndarray, " tolerances"] | None:
    """The paper's average recall: Berlin's three count as one data set; None if one of six is missing.

    `recalls` are by data set and tolerance.
    """
    if not {*BERLIN, *OTHERS} <= recalls.keys():
        return None
    berlin = np.mean([recalls[name] for name in BERLIN], axis=0)
    return np.mean([berlin, *(recalls[name] for name in OTHERS)], axis=0)


def printed_recall(row: str, dataset: str, sequence: str | None = None) -> Sequence[float] | None:
    """Recall of a system within 1, 2, 5 frames in %, on a data set or a sequence of RobotCar's; None = not printed."""
    if sequence is None:
        return printed_tables()["recall"].get(row, {}).get(dataset)
    return printed_tables()["sequences"].get(row, {}).get(sequence) if dataset == "robotcar_seasons" else None


def printed_settings(row: str) -> Mapping[str, Any]:
    """Sizes of images and candidates of a system, by column; empty = not printed."""
    families = (family for family in printed_tables()["settings"] if row.startswith(family))
    return printed_tables()["settings"].get(max(families, key=len, default=""), {})


def row_result(row: Row, results: Sequence[Mapping[str, Any]], candidates: int | str | None = None) -> RowResult | None:
    """A row's part of an evaluation's results; None if it has none."""
    parts = [part for part in results if (part["decides"] if row.ranking is None else part["system"] == row.ranking)]
    recall: dict[str, dict[float, dict[int, float]]] = {}
    for part in parts:
        sequence, threshold = part.get("sequence", OVERALL), part.get("tolerance", part.get("radius", 0))
        depths = {int(k): 100 * value for k, value in part["recall_at"].items()}
        recall.setdefault(OVERALL if sequence == MEANS[0] else sequence, {})[threshold] = depths
    recall.pop(MEANS[1], None)
    return RowResult(recall, parts[0], candidates) if parts and OVERALL in recall else None


def beside(ours: float | None, theirs: float | None, form: str = ".1f") -> str:
    """Both numbers and their difference, as far as there are."""
    if ours is None:
        return _NONE if theirs is None else f"({theirs:{form}})"
    if theirs is None:
        return f"{ours:{form}}"
    return f"{ours:{form}} ({theirs:{form}}, {round(ours, 1) - theirs:+{form}})"


def paper_tables(evaluations: Evaluations) -> Iterator[tuple[str, str, Table]]:
    """(name, heading, table) of each that is not empty."""
    names = [(evaluations.title(name), name, OVERALL) for name in evaluations.datasets]
    tables = [
        ("data_sets", "Data sets (Table I)", _data_sets(evaluations)),
        ("settings", "Settings (Table II)", _settings(evaluations)),
        ("recall", "Recall@1 in %, by data set and threshold (Tables III and VII)", _recalls(evaluations, names)),
    ]
    for name, dataset in evaluations.datasets.items():
        if len(dataset.sequences) > 1:
            parts = [*((part.name, name, part.name) for part in dataset.sequences), ("mean", name, OVERALL)]
            heading = f"Recall@1 in %, sequences of {evaluations.title(name)} (Table IV)"
            tables.append((f"sequences_{name}", heading, _recalls(evaluations, parts)))
    averages = f"Average Recall@1 in % (figure 8), here over {evaluations.averaged}"
    device = f"RobotCar's snow, an RTX 2080 Ti; here {evaluations.timed_on}"
    tables += [
        ("averages", averages, _averages(evaluations)),
        ("depths", "Recall@1, @5 and @10 in %, by data set (Table VIII)", _depths(evaluations)),
        ("sizes", "Size of the database in MiB, of float32 (Table V)", _sizes(evaluations)),
        ("seconds", f"Seconds of a query by step (Table VI: {device})", _seconds(evaluations)),
    ]
    for name, heading, table in tables:
        if table.rows:
            has_printed = any("(" in cell.replace(INCOMPLETE, "") for row in table.rows for cell in row[1:])
            yield name, heading + "; in brackets the printed numbers and the differences" * has_printed, table


def _data_sets(evaluations: Evaluations) -> Table:
    """Numbers of database images and queries."""
    rows = []
    for name, dataset in evaluations.datasets.items():
        ours = [len(dataset.database), sum(len(sequence.images) for sequence in dataset.sequences)]
        theirs = printed_tables()["data_sets"].get(name, [None, None])
        rows.append([evaluations.title(name), *(beside(*both, form=",.0f") for both in zip(ours, theirs, strict=True))])
    return Table(["data set", "reference", "queries"], rows)


def _settings(evaluations: Evaluations) -> Table:
    """Retrieval and features with the sizes of their images in px, and candidates."""
    lines: dict[str, list[str]] = {}
    for (name, _), result in evaluations.results.items():
        about, theirs = result.about, printed_settings(name)
        sides = [about[group].get("image_size") for group in ("retrieval", "features")]
        ours = [" x ".join(map(str, side)) if side else _NONE for side in sides]
        ours.append(str(result.candidates or about["candidates"]))
        values = [theirs.get(column) for column in ("retrieval", "re_ranking", "candidates")]
        cells = [cell if value is None else f"{cell} ({value})" for cell, value in zip(ours, values, strict=True)]
        lines[name] = [about["retrieval"]["name"], cells[0], about["features"]["name"], *cells[1:]]
    rows = [[row.title, *lines[row.name]] for row in evaluations.rows if row.name in lines]
    return Table(["system", "retrieval", "its images", "features", "their images", "candidates"], rows, text_columns=5)


def _recalls(evaluations: Evaluations, parts: Sequence[tuple[str, str, str]]) -> Table:
    """Recall by part and threshold; parts are (words, data set, sequence)."""
    columns = [(*part, threshold) for part in parts for threshold in evaluations.thresholds(part[1])]

    def cell(row: Row, name: str, sequence: str, threshold: float) -> str:
        result, theirs = evaluations.results.get((row.name, name)), printed_recall(row.name, name, sequence or None)
        ours = None if result is None else result.recall.get(sequence, {}).get(threshold, {}).get(1)
        return beside(ours, theirs[TOLERANCES.index(int(threshold))] if theirs and threshold in TOLERANCES else None)

    header = [f"{words} ±{threshold:g}" for words, *_, threshold in columns]
    return _filled(header, {row.title: [cell(row, *column[1:]) for column in columns] for row in evaluations.rows})


def _filled(header: Sequence[str], cells: Mapping[str, Sequence[str]]) -> Table:
    """A table of the systems that have numbers; `cells` are by title."""
    rows = [[title, *texts] for title, texts in cells.items() if any(text != _NONE for text in texts)]
    return Table(["system", *header], rows)


def _averages(evaluations: Evaluations) -> Table:
    """Means over the data sets that are here, see `Evaluations.means`, and the printed ones beside those of all six."""
    names, means = evaluations.means
    is_papers, no_values, cells = {*names} == {*BERLIN, *OTHERS}, [None] * len(TOLERANCES), {}
    for row in evaluations.rows:
        ours, theirs = means.get(row.name, no_values), average(printed_tables()["recall"].get(row.name, {}))
        pairs = zip(ours if is_papers else no_values, no_values if theirs is None else theirs, strict=True)
        cells[row.title] = [beside(*pair) for pair in pairs]
        cells[row.title] += [beside(value, None) for value in (no_values if is_papers else ours)]
    words = "of the paper's six", f"of {len(names)} here"
    table = _filled([f"{name} ±{tolerance}" for name in words for tolerance in TOLERANCES], cells)
    columns = [column for column in zip(table.header, *table.rows, strict=True) if {*column[1:]} != {_NONE}]
    header, *rows = map(list, zip(*columns, strict=True))
    return Table(header, rows)


def _depths(evaluations: Evaluations) -> Table:
    """Recall at several depths, within the threshold in the middle; Pittsburgh's beside the printed."""
    ks = (1, 5, 10)
    rows = []
    for row, name in itertools.product(evaluations.rows, evaluations.datasets):
        if result := evaluations.results.get((row.name, name)):
            recall = result.recall[OVERALL]
            threshold = middle(sorted(recall))
            theirs = printed_tables()["pitts30k"].get(row.name) if name == "pitts30k_val" else None
            cells = [beside(recall[threshold].get(k), theirs and theirs[place]) for place, k in enumerate(ks)]
            rows.append([row.title, f"{evaluations.title(name)} ±{threshold:g}", *cells])
    return Table(["system", "data set", *(f"R@{k}" for k in ks)], rows, text_columns=2)


def _sizes(evaluations: Evaluations) -> Table:
    """Sizes of the databases."""
    cells = {}
    for row in evaluations.rows:
        printed, sizes = printed_tables()["sizes"].get(row.name, {}), evaluations.sizes
        cells[row.title] = [beside(sizes.get((row.name, name)), printed.get(name)) for name in evaluations.datasets]
    return _filled([*map(evaluations.title, evaluations.datasets)], cells)


def _seconds(evaluations: Evaluations) -> Table:
    """Seconds by step, and their sum."""
    rows = []
    for row in evaluations.rows:
        theirs = printed_tables()["seconds"].get(row.name, [None] * 4)
        if steps := evaluations.seconds.get(row.name):
            ours = [steps["retrieval"], steps["features"], steps["matching"] + steps["scores"]]
            pairs = zip([*ours, sum(ours)], theirs, strict=True)
            cells = [f"{value:.3f}" + ("" if known is None else f" ({known:.2f})") for value, known in pairs]
            rows.append([row.title, *cells])
    return Table(["system", "retrieval", "features", "matching and score", "in all"], rows)
