"""What the files of a run folder say."""

import csv
import functools
import itertools
import json
import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.truth import Unit, middle, threshold_words
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.file_names import file_names
from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError, require_word

_LEFT_BY = "expected the run folder of an evaluation"
_KINDS_OF_A_ROW = {"system": str, "decides": bool, "parameters": dict, "recall_at": dict}
_KINDS = {"dataset": str, "ground_truth": dict, "data_fingerprint": dict, "filter.name": str, "features.name": str,
          "versions": dict, "seconds": dict, "queries": int, "database": int, "candidates": int,
          "bytes_per_image": int | None}  # fmt: skip
# Columns of text in front of the numbers; None = all.
_TABLES = {"table.csv": 1, "differences.csv": 2, "confidence.csv": None, "rerank_share.csv": 0,
           "precision_recall.csv": 2, "skipped.csv": None}  # fmt: skip


@dataclass(frozen=True)
class Gains:
    """Which systems are right about the Q queries of a sequence, or of several, one behind the other.

    Attributes:
        queries: names.
        places: `[Q]` whole numbers along the map.
        ranks: `[Q]` of the first right candidate by system, 0 = none is right.
    """

    queries: tuple[str, ...]
    places: np.ndarray
    ranks: Mapping[str, np.ndarray]

    def hits(self, system: str, k: int = 1) -> np.ndarray:
        """`[Q]` bool in the order of the path: whether one of the first k candidates is right."""
        ranks = self.ranks[system]
        return ((ranks > 0) & (ranks <= k))[np.argsort(self.places, kind="stable")]


@dataclass(frozen=True)
class Answer:
    """The first answer to a query; texts as they stand in the files.

    Attributes:
        system: that gave it.
        sequence: of the query.
        query: name of its image.
        answer: name of the database image; empty = none.
        score: of it.
        outcome: "right", "wrong", or "best" without ground truth.
        rank: of the first right candidate; empty = unknown, or none.
    """

    system: str
    sequence: str
    query: str
    answer: str
    score: str
    outcome: str
    rank: str


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        folder: of the run.
        results: of `results.json`, at least one row.
        about: of `run.json`.
        gains: by sequence; none without ground truth.
        tables: of its CSV files, by name; numbers are finite.
    """

    folder: Path
    results: Sequence[Mapping[str, Any]]
    about: Mapping[str, Any]
    gains: Mapping[str, Gains]
    tables: Mapping[str, Table]

    @property
    def common(self) -> Mapping[str, Any]:
        """What all rows of the results say alike: the data set, seconds, versions and so on."""
        return self.results[0]

    @cached_property
    def systems(self) -> list[str]:
        """In their order."""
        return list(dict.fromkeys(row["system"] for row in self.results))

    @cached_property
    def headline(self) -> str:
        """The system that decides."""
        return next(row["system"] for row in self.results if row["decides"])

    @cached_property
    def sequences(self) -> list[str]:
        """Names of several; one without a name of its own is called as the data set."""
        return _sequences(self.results)

    @property
    def unit(self) -> Unit:
        """Of the thresholds, with ground truth."""
        return self.common["ground_truth"]["unit"]

    @property
    def thresholds(self) -> list[float]:
        """What counts as right, ascending; none without ground truth."""
        return self.common["ground_truth"].get("thresholds", [])

    @property
    def first_k(self) -> str:
        """The smallest depth that recall is told at, with ground truth."""
        return min(self.common["recall_at"], key=int)

    @property
    def within(self) -> str:
        """What counts as right in `gains` and everything per query, as it stands behind R@K."""
        return threshold_words(self.unit, middle(self.thresholds))

    @cached_property
    def all_gains(self) -> Gains:
        """Of all sequences, with ground truth."""
        parts = [*self.gains.values()]
        return Gains(
            tuple(query for one in parts for query in one.queries),
            np.concatenate([one.places for one in parts]),
            {name: np.concatenate([one.ranks[name] for one in parts]) for name in self.systems},
        )

    def table(self, name: str, text_columns: int = 1) -> Table | None:
        """A CSV file of the folder, so many columns of it left-aligned; None where there is none."""
        found = self.tables.get(name)
        return found and replace(found, text_columns=text_columns)

    def answers(self) -> Iterator[Answer]:
        """The first answers of all systems, those of the system that decides first."""
        with _telling_which(self.folder):
            for system in sorted(self.systems, key=lambda name: name != self.headline):
                for sequence in self.sequences:
                    yield from self._answers(system, sequence)

    def _answers(self, system: str, sequence: str) -> Iterator[Answer]:
        own = sequence_folder(self.folder, self.sequences, self.sequences.index(sequence))
        path = own / "predictions" / f"{file_names(self.systems)[system]}.csv"
        first = {line["query"]: line for line in _lines(path) if line["rank"] == "1"}
        if sequence not in self.gains:
            for query, line in first.items():
                yield Answer(system, sequence, query, line["database"], line["score"], "best", "")
            return
        gains = self.gains[sequence]
        for query, rank in zip(gains.queries, gains.ranks[system].tolist(), strict=True):
            line, outcome = first.get(query, {}), "right" if rank == 1 else "wrong"
            found = line.get("database", ""), line.get("score", "")
            yield Answer(system, sequence, query, *found, outcome, str(rank or ""))


def read_run(folder: Path) -> Run:
    """The files of a run folder.

    Raises:
        InputError: there is no such folder, or its files are not those of an evaluation.
    """
    for name in ("results.json", "run.json"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: {_LEFT_BY}, got none with a {name}")
    with _telling_which(folder):
        results, about = (json.loads((folder / name).read_text("utf-8")) for name in ("results.json", "run.json"))
        _check(results, about)
        sequences = _sequences(results)
        if not sequences:
            raise ValueError("results.json has no sequence")
        paths = {name: sequence_folder(folder, sequences, place) / "gains.csv" for place, name in enumerate(sequences)}
        gains = {name: _gains(path) for name, path in paths.items() if path.exists()}
        tables = {name: _table(folder / name, text) for name, text in _TABLES.items() if (folder / name).exists()}
        run = Run(folder, results, about, gains, tables)
        if len(run.gains) != (len(sequences) if run.thresholds else 0):
            raise ValueError("each sequence with ground truth has a gains.csv, and no other")
        if any(not {*run.systems} <= {*one.ranks} for one in run.gains.values()):
            raise ValueError("gains.csv lacks a system")
        if "table.csv" in tables and not {row[0] for row in tables["table.csv"].rows} <= {*run.systems}:
            raise ValueError("table.csv has another system")
        return run


def _check(results: Any, about: Any) -> None:
    """What pages take for granted is there."""
    if not isinstance(results, list) or not results:
        raise ValueError("results.json has no rows")
    for kinds, rows in ((_KINDS_OF_A_ROW, results), (_KINDS, results[:1]), ({"settings": dict}, [about])):
        for row, (name, kind) in itertools.product(rows, kinds.items()):
            value = functools.reduce(operator.getitem, name.split("."), row)
            if not isinstance(value, kind):
                raise ValueError(f"{name} is {type(value).__name__}")
    if not any(row["decides"] for row in results):
        raise ValueError("no system decides")
    first, truth = results[0], results[0]["ground_truth"]
    if not all(isinstance(name, str) for name in first.get("incomplete", [])):
        raise ValueError("incomplete is no list of text")
    _check_numbers("seconds", first["seconds"].values())
    if thresholds := truth.get("thresholds", []):
        _check_numbers("thresholds", thresholds)
        _check_numbers("recall_at", map(int, first["recall_at"] or [""]))
        require_word("unit", truth["unit"], Unit)
    for row in results:
        _check_numbers("recall_at", row["recall_at"].values())
        if [*row["recall_at"]] != [*first["recall_at"]]:
            raise ValueError("recall_at has other depths in some rows")
        if len(thresholds) > 1:
            _check_numbers("tolerance or radius", [row.get("tolerance", row.get("radius"))])
        if not isinstance(row.get("sequence", ""), str) or ("sequence" in row) != ("sequence" in first):
            raise ValueError("sequence is missing in some rows, or no text")


def _check_numbers(name: str, values: Iterable[Any]) -> None:
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{name} has {value!r} instead of a number")


@contextmanager
def _telling_which(folder: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, StopIteration, csv.Error) as error:
        raise InputError(
            f"{folder}: {_LEFT_BY} of this version, got other files ({type(error).__name__}: {error})"
        ) from None


def _sequences(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Their names, without those of their means, which come last."""
    first = results[0]
    if "sequence" not in first:
        return [first["dataset"]]
    return list(dict.fromkeys(row["sequence"] for row in results))[: -len(MEANS)]


def _table(path: Path, num_texts: int | None) -> Table:
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        header, *rows = csv.reader(file)
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"{path.name} has lines of different lengths")
    if num_texts is not None:
        columns = range(num_texts + ("sequence" in header), len(header))
        numbers = {header[place]: [float(row[place]) for row in rows] for place in columns}
        numbers.pop("threshold", None)  # of scores, which may be infinite
        _check_numbers(path.name, itertools.chain.from_iterable(numbers.values()))
    return Table(header, rows)


def _gains(path: Path) -> Gains:
    lines = [*_lines(path)]
    names = [name.removesuffix(" rank") for name in lines[0] if name.endswith(" rank")]
    ranks = {name: np.array([int(line[f"{name} rank"] or 0) for line in lines]) for name in names}
    places = [int(line["place"] or place) for place, line in enumerate(lines)]
    return Gains(tuple(line["query"] for line in lines), np.array(places), ranks)


def _lines(path: Path) -> Iterator[dict[str, str]]:
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        yield from csv.DictReader(file)
