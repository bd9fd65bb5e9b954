"""The paper's tables: numbers of the evaluations at hand beside the printed ones, and averages of both."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
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
_BRACKETS = "; in brackets the printed numbers and the differences"


@dataclass(frozen=True)
class RowResult:
    """The result of a row's ranking on a data set: recall in % by sequence (`OVERALL` for all), threshold and depth.

    `about` are settings, from the results.
    """

    recall: Mapping[str, Mapping[float, Mapping[int, float]]]
    about: Mapping[str, Any]


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
        is_papers = {*BERLIN, *OTHERS} <= {*names}
        names = [name for name in names if not is_papers or name in (*BERLIN, *OTHERS)]
        means = {}
        for row in self.rows:
            recalls = {
                name: np.array([self.recall(row, name, OVERALL, at) for at in TOLERANCES], float) for name in names
            }
            if names and np.isfinite([*recalls.values()]).all():  # None became NaN
                means[row.name] = average(recalls) if is_papers else np.mean([*recalls.values()], axis=0)
        return names, means

    @property
    def averaged(self) -> str:
        """The data sets of the means, in words."""
        return ", ".join(map(self.title, self.means[0])) or "none"

    def recall(self, row: Row, dataset: str, sequence: str, threshold: float, k: int = 1) -> float | None:
        """Recall of a row in %, None = it has none."""
        result = self.results.get((row.name, dataset))
        return None if result is None else result.recall.get(sequence, {}).get(threshold, {}).get(k)

    def thresholds(self, dataset: str) -> list[float]:
        """Thresholds of a data set's evaluations."""
        recalls = (result.recall[OVERALL] for (_, name), result in self.results.items() if name == dataset)
        return sorted(next(recalls, {}))


@cache
def printed_tables() -> Mapping[str, Any]:
    """Tables by their names in printed.yaml, which describes them."""
    return yaml.safe_load((Path(__file__).parent / "printed.yaml").read_text(encoding="utf-8"))


def average(recalls: Mapping[str, Any]) -> Float[np.ndarray, " tolerances"] | None:
    """The paper's average recall: Berlin's three count as one data set; None if one of six is missing.

    `recalls` are by data set and tolerance.
    """
    if not {*BERLIN, *OTHERS} <= recalls.keys():
        return None
    berlin = np.mean([recalls[name] for name in BERLIN], axis=0)
    return np.mean([berlin, *(recalls[name] for name in OTHERS)], axis=0)


def row_result(row: Row, results: Sequence[Mapping[str, Any]]) -> RowResult | None:
    """A row's part of an evaluation's results; None if it has none."""
    parts = [part for part in results if (part["decides"] if row.ranking is None else part["system"] == row.ranking)]
    recall: dict[str, dict[float, dict[int, float]]] = {}
    for part in parts:
        sequence, threshold = part.get("sequence", OVERALL), part.get("tolerance", part.get("radius", 0))
        depths = {int(k): 100 * value for k, value in part["recall_at"].items()}
        recall.setdefault(OVERALL if sequence == MEANS[0] else sequence, {})[threshold] = depths
    recall.pop(MEANS[1], None)
    return RowResult(recall, parts[0]) if parts and OVERALL in recall else None


def beside(ours: float | None, theirs: float | None, form: str = ".1f") -> str:
    """Both numbers and their difference, as far as there are."""
    if ours is None:
        return _NONE if theirs is None else f"({theirs:{form}})"
    text = f"{ours:{form}}"
    return text if theirs is None else f"{text} ({theirs:{form}}, {float(text.replace(',', '')) - theirs:+{form}})"


Cells = Mapping[str, tuple[float | None, float | None]]  # by column: the number here, and the printed one


def paper_tables(evaluations: Evaluations) -> Iterator[tuple[str, str, Table]]:
    """(name, heading, table) of each that is not empty; systems without numbers are left out."""
    yield "data_sets", f"Data sets (Table I){_BRACKETS}", _data_sets(evaluations)
    yield "settings", f"Settings (Table II){_BRACKETS}", _settings(evaluations)
    parts = [(evaluations.title(name), name, OVERALL) for name in evaluations.datasets]
    heading = "Recall@1 in %, by data set and threshold (Tables III and VII)"
    tables: dict[str, tuple[str, Any]] = {"recall": (heading, partial(_recalls, parts=parts))}
    for name, dataset in evaluations.datasets.items():
        if len(dataset.sequences) > 1:
            parts = [*((part.name, name, part.name) for part in dataset.sequences), ("mean", name, OVERALL)]
            heading = f"Recall@1 in %, sequences of {evaluations.title(name)} (Table IV)"
            tables[f"sequences_{name}"] = heading, partial(_recalls, parts=parts)
    tables["averages"] = f"Average Recall@1 in % (figure 8), here over {evaluations.averaged}", _averages
    tables["depths"] = "Recall@1, @5 and @10 in %, by data set (Table VIII)", _depths
    tables["sizes"] = "Size of the database in MiB, of float32 (Table V)", _sizes
    device = f"RobotCar's snow, an RTX 2080 Ti; here {evaluations.timed_on}"
    tables["seconds"] = f"Seconds of a query by step (Table VI: {device})", _seconds
    for name, (heading, cells_of) in tables.items():
        by_title = {row.title: cells_of(evaluations, row) for row in evaluations.rows}
        by_title = {title: cells for title, cells in by_title.items() if {*cells.values()} - {(None, None)}}
        if by_title:
            form, columns = ".3f" if name == "seconds" else ".1f", [*next(iter(by_title.values()))]
            lines = [
                [title, *(beside(*cells[column], form=form) for column in columns)] for title, cells in by_title.items()
            ]
            has_printed = any("(" in cell for line in lines for cell in line[1:])
            yield name, heading + _BRACKETS * has_printed, Table(["system", *columns], lines)


def _data_sets(evaluations: Evaluations) -> Table:
    """Numbers of database images and queries."""
    rows = []
    for name, dataset in evaluations.datasets.items():
        ours = [len(dataset.database), sum(len(sequence.images) for sequence in dataset.sequences)]
        theirs = printed_tables()["data_sets"].get(name, [None, None])
        rows.append([evaluations.title(name), *(beside(*both, form=",.0f") for both in zip(ours, theirs, strict=True))])
    return Table(["data set", "reference", "queries"], rows)


def _settings(evaluations: Evaluations) -> Table:
    """Retrieval and features with the sizes of their images in px, and candidates; printed ones are by family."""
    lines, printed = dict[str, list[str]](), printed_tables()["settings"]
    for (name, _), result in evaluations.results.items():
        about, families = result.about, [family for family in printed if name.startswith(family)]
        theirs = printed.get(max(families, key=len, default=""), {})
        sides = [about[group].get("image_size") for group in ("retrieval", "features")]
        ours = [" x ".join(map(str, side)) if side else _NONE for side in sides]
        ours.append(str(about["candidates"]))
        values = [theirs.get(column) for column in ("retrieval", "re_ranking", "candidates")]
        cells = [cell if value is None else f"{cell} ({value})" for cell, value in zip(ours, values, strict=True)]
        lines[name] = [about["retrieval"]["name"], cells[0], about["features"]["name"], *cells[1:]]
    rows = [[row.title, *lines[row.name]] for row in evaluations.rows if row.name in lines]
    return Table(["system", "retrieval", "its images", "features", "their images", "candidates"], rows, text_columns=5)


def _recalls(evaluations: Evaluations, row: Row, parts: Sequence[tuple[str, str, str]]) -> Cells:
    """Recall by part and threshold; parts are (words, data set, sequence)."""
    printed, cells = printed_tables(), {}
    for words, name, sequence in parts:
        theirs = printed["recall"].get(row.name, {}).get(name)
        if sequence:  # only RobotCar's are printed
            theirs = printed["sequences"].get(row.name, {}).get(sequence) if name == "robotcar_seasons" else None
        known: dict[float, float] = dict(zip(TOLERANCES, theirs or (), strict=False))
        for threshold in evaluations.thresholds(name):
            ours = evaluations.recall(row, name, sequence, threshold)
            cells[f"{words} ±{threshold:g}"] = ours, known.get(threshold)
    return cells


def _averages(evaluations: Evaluations, row: Row) -> Cells:
    """Means over the data sets that are here, see `Evaluations.means`, and the printed ones beside those of all six."""
    names, means = evaluations.means
    is_papers, none = {*names} == {*BERLIN, *OTHERS}, [None] * len(TOLERANCES)
    ours, theirs = means.get(row.name, none), average(printed_tables()["recall"].get(row.name, {}))
    pairs = zip(TOLERANCES, ours, none if theirs is None else theirs, strict=True)
    cells, here = {}, {}
    for tolerance, mean, printed in pairs:
        cells[f"of the paper's six ±{tolerance}"] = mean if is_papers else None, printed
        here[f"of {len(names)} here ±{tolerance}"] = mean, None
    return cells if is_papers else cells | here


def _depths(evaluations: Evaluations, row: Row) -> Cells:
    """Recall at several depths, within the threshold in the middle; Pittsburgh's beside the printed."""
    cells = {}
    for name in evaluations.datasets:
        threshold = middle(evaluations.thresholds(name) or [0])
        theirs = printed_tables()["pitts30k"].get(row.name) if name == "pitts30k_val" else None
        for place, k in enumerate((1, 5, 10)):
            ours = evaluations.recall(row, name, OVERALL, threshold, k)
            cells[f"{evaluations.title(name)} ±{threshold:g} R@{k}"] = ours, theirs and theirs[place]
    return cells


def _sizes(evaluations: Evaluations, row: Row) -> Cells:
    """Sizes of the databases."""
    printed, sizes = printed_tables()["sizes"].get(row.name, {}), evaluations.sizes
    return {evaluations.title(name): (sizes.get((row.name, name)), printed.get(name)) for name in evaluations.datasets}


def _seconds(evaluations: Evaluations, row: Row) -> Cells:
    """Seconds by step, and their sum; nothing of systems that were not timed."""
    columns, steps = ("retrieval", "features", "matching and score", "in all"), evaluations.seconds.get(row.name)
    if steps is None:
        return dict.fromkeys(columns, (None, None))
    ours = [steps["retrieval"], steps["features"], steps["matching"] + steps["scores"]]
    theirs = printed_tables()["seconds"].get(row.name, [None] * 4)
    return dict(zip(columns, zip([*ours, sum(ours)], theirs, strict=True), strict=True))
