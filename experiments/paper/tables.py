"""The paper's tables, of what was evaluated here, each number beside the printed one."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from experiments.paper.printed import BERLIN, OTHERS, average, printed, printed_recall, printed_settings
from experiments.paper.systems import Row
from mfvpr.datasets import Dataset
from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.published import differences
from mfvpr.datasets.truth import middle
from mfvpr.report import Table

INCOMPLETE = " (incomplete)"
OVERALL = ""  # in place of a sequence: the only one, or the plain mean of several
TOLERANCES = (1, 2, 5)  # of the printed recalls
_NONE = "-"


@dataclass(frozen=True)
class Evaluated:
    """What a row's ranking achieves on a data set.

    Attributes:
        recall: in %, by sequence (`OVERALL` for all), threshold and depth.
        about: settings of the evaluation, as its results keep them.
        asked: candidates, of which a small database has fewer; None = as many as there were.
    """

    recall: Mapping[str, Mapping[float, Mapping[int, float]]]
    about: Mapping[str, Any]
    asked: int | str | None = None


@dataclass(frozen=True)
class Found:
    """All that was evaluated.

    Attributes:
        rows: of the tables.
        datasets: that are here, by name.
        evaluated: by row and data set.
        seconds: by row: of a query, by step; see `timing`.
        sizes: by row and data set: bytes of an image's features in float32, as the paper counts them.
        timed_on: the data set and the device of the seconds, in words.
    """

    rows: Sequence[Row]
    datasets: Mapping[str, Dataset]
    evaluated: Mapping[tuple[str, str], Evaluated]
    seconds: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sizes: Mapping[tuple[str, str], float] = field(default_factory=dict)
    timed_on: str = ""

    def title(self, name: str) -> str:
        """A data set's name; one that lacks images is called so."""
        return name + INCOMPLETE * (next(differences(self.datasets[name]), None) is not None)

    @cached_property
    def means(self) -> tuple[list[str], dict[str, np.ndarray]]:
        """Data sets, and by row the mean recall `[tolerances]` over them.

        They are the paper's six, as the paper averages them, where all of these are here; else all that are judged by
        these tolerances. Rows that lack one have no mean.
        """
        names = [name for name in self.datasets if {*TOLERANCES} <= {*thresholds_of(self, name)}]
        six = [name for name in names if name in (*BERLIN, *OTHERS)]
        names = six if len(six) == len(BERLIN) + len(OTHERS) else names
        found = {}
        for row in self.rows:
            own = {name: _at(self.evaluated[row.name, name]) for name in names if (row.name, name) in self.evaluated}
            if names and len(own) == len(names):
                macro = average(own)
                found[row.name] = np.mean([*own.values()], axis=0) if macro is None or names != six else macro
        return names, found

    def known(self, rows: Iterable[Row], datasets: Iterable[str]) -> list[Row]:
        """Those that were evaluated on one of the data sets, or are printed for it."""
        names = [*datasets]
        return [
            row for row in rows
            if any((row.name, name) in self.evaluated or printed_recall(row.name, name) for name in names)
        ]  # fmt: skip


def evaluated(row: Row, results: Sequence[Mapping[str, Any]], asked: int | str | None = None) -> Evaluated | None:
    """A row's part of an evaluation's results; None where it has none."""
    own = [one for one in results if (one["decides"] if row.ranking is None else one["system"] == row.ranking)]
    recall: dict[str, dict[float, dict[int, float]]] = {}
    for one in own:
        sequence, threshold = one.get("sequence", OVERALL), one.get("tolerance", one.get("radius", 0))
        depths = {int(k): 100 * value for k, value in one["recall_at"].items()}
        recall.setdefault(OVERALL if sequence == MEANS[0] else sequence, {})[threshold] = depths
    recall.pop(MEANS[1], None)
    return Evaluated(recall, own[0], asked) if own and OVERALL in recall else None


def beside(ours: float | None, theirs: float | None, form: str = ".1f") -> str:
    """Both numbers and their difference, as far as there are."""
    if ours is None:
        return _NONE if theirs is None else f"({theirs:{form}})"
    if theirs is None:
        return f"{ours:{form}}"
    return f"{ours:{form}} ({theirs:{form}}, {round(ours, 1) - theirs:+{form}})"


def tables(found: Found) -> Iterator[tuple[str, str, Table]]:
    """(name, heading, table) of each that is not empty."""
    candidates = (
        ("data_sets", "Data sets (Table I)", data_sets(found)),
        ("settings", "Settings (Table II)", settings(found)),
        ("recall", "Recall@1 in %, by data set and threshold (Tables III and VII)", recalls(found)),
        *(
            (f"sequences_{name}", f"Recall@1 in %, sequences of {found.title(name)} (Table IV)", sequences(found, name))
            for name, dataset in found.datasets.items()
            if len(dataset.sequences) > 1
        ),
        ("averages", f"Average Recall@1 in % (figure 8), here over {listed(found)}", averages(found)),
        ("depths", "Recall@1, @5 and @10 in %, by data set (Table VIII)", depths(found)),
        ("sizes", "Size of the database in MiB, of float32 (Table V)", sizes(found)),
        ("seconds", "Seconds of a query by step (Table VI: "
         f"RobotCar's snow, an RTX 2080 Ti; here {found.timed_on})", seconds(found)),
    )  # fmt: skip
    for name, heading, table in candidates:
        if table.rows:
            has_printed = any("(" in cell.replace(INCOMPLETE, "") for row in table.rows for cell in row[1:])
            yield name, heading + "; in brackets the printed numbers and the differences" * has_printed, table


def listed(found: Found) -> str:
    """The data sets of the means."""
    return ", ".join(map(found.title, found.means[0])) or "none"


def data_sets(found: Found) -> Table:
    """Images of reference and queries."""
    rows = []
    for name, dataset in found.datasets.items():
        ours = [len(dataset.database), sum(len(sequence.images) for sequence in dataset.sequences)]
        theirs = printed()["data_sets"].get(name, [None, None])
        rows.append([found.title(name), *(beside(*both, form=",.0f") for both in zip(ours, theirs, strict=True))])
    return Table(["data set", "reference", "queries"], rows)


def settings(found: Found) -> Table:
    """Filter and features with the sizes of their images in px, and candidates."""
    lines: dict[str, list[str]] = {}
    for (name, _), one in found.evaluated.items():
        about, theirs = one.about, printed_settings(name)
        sides = [about[group].get("image_size") for group in ("filter", "features")]
        sizes = [" x ".join(map(str, side)) if side else _NONE for side in sides]
        ours = [sizes[0], sizes[1], str(one.asked or about["candidates"])]
        beside_them = [theirs.get(column) for column in ("filter", "re_ranking", "candidates")]
        cells = [cell if value is None else f"{cell} ({value})" for cell, value in zip(ours, beside_them, strict=True)]
        lines[name] = [about["filter"]["name"], cells[0], about["features"]["name"], *cells[1:]]
    rows = [[row.title, *lines[row.name]] for row in found.rows if row.name in lines]
    return Table(["system", "filter", "its images", "features", "their images", "candidates"], rows, text_columns=5)


def recalls(found: Found) -> Table:
    """All systems by data set and threshold."""
    columns = [(name, threshold) for name in found.datasets for threshold in thresholds_of(found, name)]
    rows = []
    for row in found.known(found.rows, found.datasets):
        cells = [_cell(found, row, name, OVERALL, threshold) for name, threshold in columns]
        rows.append([row.title, *cells])
    return Table(
        ["system", *(f"{found.title(name)} ±{threshold:g}" for name, threshold in columns)], rows if columns else []
    )


def sequences(found: Found, dataset: str) -> Table:
    """All systems in each sequence of a data set, and their plain mean."""
    thresholds = thresholds_of(found, dataset)
    parts = [sequence.name for sequence in found.datasets[dataset].sequences]
    columns = [(part, threshold) for part in (*parts, OVERALL) for threshold in thresholds]
    rows = [
        [row.title, *(_cell(found, row, dataset, part, threshold) for part, threshold in columns)]
        for row in found.known(found.rows, [dataset])
    ]
    return Table(
        ["system", *(f"{part or 'mean'} ±{threshold:g}" for part, threshold in columns)], rows if columns else []
    )


def averages(found: Found) -> Table:
    """Means over the data sets that are here, see `Found.means`, and the printed ones beside those of the same six."""
    names, means = found.means
    is_papers = {*names} == {*BERLIN, *OTHERS}
    rows = []
    for row in found.rows:
        theirs, ours = average(printed()["recall"].get(row.name, {})), _or_none(means.get(row.name))
        if row.name not in means and theirs is None:
            continue
        papers = zip(ours if is_papers else _or_none(None), _or_none(theirs), strict=True)
        own = _or_none(None) if is_papers else ours
        rows.append([row.title, *(beside(*both) for both in papers), *(beside(one, None) for one in own)])
    header = [f"of the paper's six ±{t}" for t in TOLERANCES] + [f"of {len(names)} here ±{t}" for t in TOLERANCES]
    return _without_empty_columns(Table(["system", *header], rows))


def _without_empty_columns(table: Table) -> Table:
    kept = [place for place in range(len(table.header)) if any(row[place] != _NONE for row in table.rows)]
    rows = [[row[place] for place in kept] for row in table.rows]
    return Table([table.header[place] for place in kept], rows) if rows else table


def depths(found: Found) -> Table:
    """Recall at several depths, within the threshold in the middle; Pittsburgh's beside the printed."""
    ks = (1, 5, 10)
    rows = []
    for row in found.rows:
        for name in found.datasets:
            if one := found.evaluated.get((row.name, name)):
                recall = one.recall[OVERALL]
                threshold = middle(sorted(recall))
                theirs = printed()["pitts30k"].get(row.name) if name == "pitts30k_val" else None
                cells = [beside(recall[threshold].get(k), theirs and theirs[at]) for at, k in enumerate(ks)]
                rows.append([row.title, f"{found.title(name)} ±{threshold:g}", *cells])
    return Table(["system", "data set", *(f"R@{k}" for k in ks)], rows, text_columns=2)


def sizes(found: Found) -> Table:
    """Bytes of an image times images of the database."""
    rows = []
    for row in found.rows:
        theirs = printed()["sizes"].get(row.name, {})
        cells = []
        for name, dataset in found.datasets.items():
            size = found.sizes.get((row.name, name))
            cells.append(beside(None if size is None else size * len(dataset.database) / 2**20, theirs.get(name)))
        if any(cell != _NONE for cell in cells):
            rows.append([row.title, *cells])
    return Table(["system", *map(found.title, found.datasets)], rows)


def seconds(found: Found) -> Table:
    """By step, and in all."""
    rows = []
    for row in found.rows:
        theirs = printed()["seconds"].get(row.name, [None] * 4)
        if ours := found.seconds.get(row.name):
            steps = [ours["filter"], ours["features"], ours["matching"] + ours["scores"]]
            own = [*steps, sum(steps)]
            cells = [_second(*both) for both in zip(own, theirs, strict=True)]
            rows.append([row.title, *cells])
    return Table(["system", "filter", "features", "matching and score", "in all"], rows)


def _second(ours: float, theirs: float | None) -> str:
    return f"{ours:.3f}" if theirs is None else f"{ours:.3f} ({theirs:.2f})"


def thresholds_of(found: Found, dataset: str) -> list[float]:
    """Of a data set's evaluations."""
    known = (one.recall[OVERALL] for (_, name), one in found.evaluated.items() if name == dataset)
    return sorted(next(known, {}))


def _cell(found: Found, row: Row, dataset: str, sequence: str, threshold: float) -> str:
    one = found.evaluated.get((row.name, dataset))
    ours = None if one is None else one.recall.get(sequence, {}).get(threshold, {}).get(1)
    theirs = printed_recall(row.name, dataset, sequence or None)
    at = TOLERANCES.index(int(threshold)) if threshold in TOLERANCES else None
    return beside(ours, theirs[at] if theirs and at is not None else None)


def _at(one: Evaluated) -> list[float]:
    return [one.recall[OVERALL][tolerance][1] for tolerance in TOLERANCES]


def _or_none(values: Any) -> Sequence[float | None]:
    return [None] * len(TOLERANCES) if values is None else list(values)
