"""The paper's tables: numbers of the evaluations at hand beside the printed ones, and averages of both."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from experiments.paper.systems import Row
from mfvpr.datasets import Dataset
from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle
from mfvpr.datasets.published import published_differences
from mfvpr.report import Table
from mfvpr.utils.files import read_yaml

BERLIN = ("berlin_a100", "berlin_kudamm", "berlin_halenseestrasse")
SEPARATE = ("gardens_point", "nordland_1415", "robotcar_seasons")
OVERALL = ""  # in place of a sequence: the only one, or the plain mean of several
TOLERANCES, DEPTHS = (1, 2, 5), (1, 5, 10)  # of the printed recalls
_NONE = "-"
_BRACKETS = "; in brackets the printed numbers and the differences"

Recalls = dict[tuple[str, str, str, float, int], float]  # in %, by row, data set, sequence, threshold and depth
Cells = Mapping[str, tuple[float | None, float | None]]  # by column: the number here, and the printed one


@dataclass(frozen=True)
class Evaluations:
    """All evaluations at hand.

    Attributes:
        rows: of the tables.
        datasets: at hand, by name.
        recalls: here; of all queries if the sequence is `OVERALL`.
        sizes: by row and data set: MiB of the database's features in float32, as the paper counts them.
        seconds: of a query, by row and step; see `runs.measure_query`.
        timed_on: the data set and the device of the seconds, in words.
        folders: run folders by data set and evaluation.
    """

    rows: Sequence[Row]
    datasets: Mapping[str, Dataset]
    recalls: Recalls
    sizes: dict[tuple[str, str], float] = field(default_factory=dict)
    seconds: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    timed_on: str = ""
    folders: Mapping[tuple[str, str], Path] = field(default_factory=dict)

    def title(self, name: str) -> str:
        """A data set's name, marked if it lacks images."""
        return name + " (incomplete)" * any(published_differences(self.datasets[name]))

    def thresholds(self, dataset: str) -> list[float]:
        """Thresholds of a data set's evaluations."""
        return sorted({threshold for _, name, _, threshold, _ in self.recalls if name == dataset})


@cache
def printed_tables() -> Mapping[str, Any]:
    """Tables by their names in printed.yaml, which describes them."""
    return read_yaml(Path(__file__).with_name("printed.yaml"))


def average(recalls: Mapping[str, Any]) -> Float[np.ndarray, " tolerances"]:
    """The paper's average of recalls by data set and tolerance: Berlin's three count as one data set."""
    berlin = np.mean([recalls[name] for name in BERLIN], axis=0)
    return np.mean([berlin, *(recalls[name] for name in SEPARATE)], axis=0)


@cache
def printed_recalls() -> Recalls:
    """The printed recalls, as those of `Evaluations`: overall, of RobotCar's sequences, and of Pittsburgh's depths."""
    printed = printed_tables()
    by_part = {(row, name, OVERALL): each for row, parts in printed["recall"].items() for name, each in parts.items()}
    for row, parts in printed["sequences"].items():
        by_part |= {(row, "robotcar_seasons", sequence): each for sequence, each in parts.items()}
    recalls: Recalls = {(*part, at, 1): value for part, values in by_part.items()
               for at, value in zip(TOLERANCES, values, strict=True)}  # fmt: skip
    for row, values in printed["pitts30k"].items():
        recalls |= {(row, "pitts30k_val", OVERALL, 25, k): value for k, value in zip(DEPTHS, values, strict=True)}
    return recalls


def recalls_of(row: Row, dataset: str, results: Sequence[Mapping[str, Any]]) -> Recalls:
    """The recalls of a row in an evaluation's results."""
    recalls = {}
    for part in results:
        sequence, threshold = part.get("sequence", OVERALL), part.get("tolerance", part.get("radius", 0))
        key = row.name, dataset, OVERALL if sequence == MEANS[0] else sequence, threshold
        if (part["decides"] if row.ranking is None else part["system"] == row.ranking) and sequence != MEANS[1]:
            recalls |= {(*key, int(k)): 100 * value for k, value in part["recall_at"].items()}
    return recalls


def beside(ours: float | None, theirs: float | None, form: str = ".1f") -> str:
    """Both numbers and their difference, as far as there are."""
    if ours is None:
        return _NONE if theirs is None else f"({theirs:{form}})"
    text = f"{ours:{form}}"
    return text if theirs is None else f"{text} ({theirs:{form}}, {float(text.replace(',', '')) - theirs:+{form}})"


def paper_tables(evaluations: Evaluations) -> Iterator[tuple[str, str, Table]]:
    """(name, heading, table) of each that is not empty; systems without numbers are left out."""
    yield "data_sets", f"Data sets (Table I){_BRACKETS}", _data_sets(evaluations)
    recall, depths = {}, {}  # columns: what they show
    heading = "Recall@1 in %, by data set and threshold (Tables III and VII)"
    tables: dict[str, tuple[str, Any]] = {"recall": (heading, partial(_recalls, columns=recall))}
    for name, dataset in evaluations.datasets.items():
        title, thresholds = evaluations.title(name), evaluations.thresholds(name)
        recall |= {f"{title} ±{at:g}": (name, OVERALL, at, 1) for at in thresholds}
        for at in [middle(thresholds)] if thresholds else []:
            depths |= {f"{title} ±{at:g} R@{k}": (name, OVERALL, at, k) for k in DEPTHS}
        if len(dataset.sequences) > 1:
            words = {part.name: part.name for part in dataset.sequences} | {"mean": OVERALL}
            parts = {f"{word} ±{at:g}": (name, part, at, 1) for word, part in words.items() for at in thresholds}
            heading = f"Recall@1 in %, sequences of {title} (Table IV)"
            tables[f"sequences_{name}"] = heading, partial(_recalls, columns=parts)
    averaged = averaged_datasets(evaluations)
    heading = f"Average Recall@1 in % (figure 8), here over {', '.join(map(evaluations.title, averaged)) or 'none'}"
    tables["averages"] = heading, partial(_averages, names=averaged)
    heading = "Recall@1, @5 and @10 in %, by data set (Table VIII)"
    tables["depths"] = heading, partial(_recalls, columns=depths)
    tables["sizes"] = "Size of the database in MiB, of float32 (Table V)", _sizes
    device = f"RobotCar's snow, an RTX 2080 Ti; here {evaluations.timed_on}"
    tables["seconds"] = f"Seconds of a query by step (Table VI: {device})", _seconds
    for name, (heading, cells_of) in tables.items():
        form, columns, lines = ".3f" if name == "seconds" else ".1f", list[str](), list[list[str]]()
        for row in evaluations.rows:
            cells: Cells = cells_of(evaluations, row)
            if {*cells.values()} - {(None, None)}:
                columns = [*cells]
                lines.append([row.title, *(beside(*both, form=form) for both in cells.values())])
        if lines:
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


def _recalls(evaluations: Evaluations, row: Row, columns: Mapping[str, tuple[str, str, float, int]]) -> Cells:
    """Recall by data set, sequence, threshold and depth of each column."""
    keys = {column: (row.name, *key) for column, key in columns.items()}
    return {column: (evaluations.recalls.get(key), printed_recalls().get(key)) for column, key in keys.items()}


def averaged_datasets(evaluations: Evaluations) -> list[str]:
    """The paper's six data sets, if all are here; else all with the paper's tolerances."""
    names = [name for name in evaluations.datasets if {*TOLERANCES} <= {*evaluations.thresholds(name)}]
    is_papers = {*BERLIN, *SEPARATE} <= {*names}
    return [name for name in names if not is_papers or name in (*BERLIN, *SEPARATE)]


def _averages(evaluations: Evaluations, row: Row, names: Sequence[str]) -> Cells:
    """Means over data sets, of rows that have all of them, and the printed ones beside those of the paper's six."""
    keys = [[(row.name, name, OVERALL, at, 1) for at in TOLERANCES] for name in names]
    recalls = np.array([[evaluations.recalls.get(key, np.nan) for key in of_name] for of_name in keys])
    is_papers, means, known = {*names} == {*BERLIN, *SEPARATE}, [None] * 3, [None] * 3
    if names and np.isfinite(recalls).all():
        means = average(dict(zip(names, recalls, strict=True))) if is_papers else recalls.mean(axis=0)
    if row.name in printed_tables()["recall"]:
        known = average(printed_tables()["recall"][row.name])
    cells, here = {}, {}
    for at, mean, printed in zip(TOLERANCES, means, known, strict=True):
        cells[f"of the paper's six ±{at}"] = mean if is_papers else None, printed
        here[f"of {len(names)} here ±{at}"] = mean, None
    return cells if is_papers else cells | here


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
