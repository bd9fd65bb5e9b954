"""Reading the files of a run folder."""

import csv
import functools
import itertools
import json
import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import Unit, middle, threshold_words
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.runs import LAST, file_names
from mfvpr.report.tables import Table, read_csv
from mfvpr.utils.errors import InputError, require_word

_KINDS_OF_A_ROW = {"system": str, "decides": bool, "parameters": dict, "recall_at": dict}
_KINDS = {"dataset": str, "ground_truth": dict, "data_fingerprint": dict, "retrieval.name": str, "features.name": str,
          "versions": dict, "seconds": dict, "queries": int, "database": int, "candidates": int,
          "bytes_per_image": int | None}  # fmt: skip
# Columns of text in front of the numbers; None = all.
_TABLES = {"table.csv": 1, "differences.csv": 2, "confidence.csv": None, "rerank_share.csv": 0,
           "precision_recall.csv": 2, "changes.csv": None, "skipped.csv": None}  # fmt: skip


@dataclass(frozen=True)
class Gains:
    """Ranks of the first correct candidates for the Q queries of one sequence, or of several, one after the other.

    `queries` are names, `places` are along the map, `ranks` are by system, 0 = no candidate is correct.
    """

    queries: tuple[str, ...]
    places: Int[np.ndarray, " queries"]
    ranks: Mapping[str, Int[np.ndarray, " queries"]]

    def hits(self, system: str, k: int = 1) -> Bool[np.ndarray, " queries"]:
        """In the order of the path, whether one of the first k candidates is correct."""
        ranks = self.ranks[system]
        return ((ranks > 0) & (ranks <= k))[np.argsort(self.places, kind="stable")]


@dataclass(frozen=True)
class Prediction:
    """The first prediction of a system for a query, as texts of the files.

    `outcome` is "correct", "incorrect", or "best" without ground truth. Without a prediction, `prediction` and `score`
    are empty. `rank` is of the first correct candidate, empty if there is none or if it is unknown.
    """

    system: str
    sequence: str
    query: str
    prediction: str
    score: str
    outcome: str
    rank: str


@dataclass(frozen=True)
class Run:
    """A run folder, the rows of its `results.json`, and its `run.json`."""

    folder: Path
    results: Sequence[Mapping[str, Any]]
    about: Mapping[str, Any]

    @property
    def common(self) -> Mapping[str, Any]:
        """Values that all rows of the results share: the data set, seconds, versions and so on."""
        return self.results[0]

    @cached_property
    def systems(self) -> list[str]:
        """Names of the systems, in the order of the results."""
        return list(dict.fromkeys(row["system"] for row in self.results))

    @cached_property
    def headline(self) -> str:
        """The system that decides."""
        return next(row["system"] for row in self.results if row["decides"])

    @cached_property
    def sequences(self) -> list[str]:
        """Names of the sequences; a single one without a name has the data set's."""
        if "sequence" not in self.common:
            return [self.common["dataset"]]
        return list(dict.fromkeys(row["sequence"] for row in self.results))[: -len(MEANS)]  # their means come last

    @property
    def thresholds(self) -> list[float]:
        """Distances within which a prediction is correct, ascending; none without ground truth."""
        return self.common["ground_truth"].get("thresholds", [])

    @property
    def within(self) -> str:
        """The threshold of `gains` and of all values per query, as it stands behind R@K."""
        return threshold_words(self.common["ground_truth"]["unit"], middle(self.thresholds))

    @cached_property
    def tables(self) -> Mapping[str, Table]:
        """Tables of the CSV files, by name; numbers are finite."""
        return {name: read_table(self.folder / name, text) for name, text in _TABLES.items()
                if (self.folder / name).exists()}  # fmt: skip

    @cached_property
    def gains(self) -> Mapping[str, Gains]:
        """Gains by sequence; none without ground truth."""
        paths = [sequence_folder(self.folder, self.sequences, place) for place in range(len(self.sequences))]
        return {name: _gains(path / "gains.csv") for name, path in zip(self.sequences, paths, strict=True)
                if (path / "gains.csv").exists()}  # fmt: skip

    @cached_property
    def all_gains(self) -> Gains:
        """Gains of all sequences, with ground truth."""
        parts = [*self.gains.values()]
        return Gains(
            tuple(query for gains in parts for query in gains.queries),
            np.concatenate([gains.places for gains in parts]),
            {name: np.concatenate([gains.ranks[name] for gains in parts]) for name in self.systems},
        )

    def predictions(self) -> Iterator[Prediction]:
        """The first predictions of all systems, those of the system that decides first."""
        systems, files = sorted(self.systems, key=lambda name: name != self.headline), file_names(self.systems)
        with errors_as_input_errors(self.folder):
            for system, (place, sequence) in itertools.product(systems, enumerate(self.sequences)):
                folder = sequence_folder(self.folder, self.sequences, place) / "predictions"
                first = {row["query"]: row for row in read_csv(folder / f"{files[system]}.csv") if row["rank"] == "1"}
                ranks: Mapping[str, int | None] = dict.fromkeys(first)
                if gains := self.gains.get(sequence):
                    ranks = dict(zip(gains.queries, gains.ranks[system].tolist(), strict=True))
                for query, rank in ranks.items():
                    row, outcome = first.get(query), "best" if rank is None else "correct" if rank == 1 else "incorrect"
                    texts = (row["database"], row["score"]) if row else ("", "")
                    yield Prediction(system, sequence, query, *texts, outcome, str(rank or ""))


def read_results(folder: Path, name: str = LAST) -> Any:
    """The content of a JSON file of a run folder; InputError if there is none."""
    if not (folder / name).is_file():
        raise InputError(f"{folder}: expected a run folder, got one without {name}")
    with errors_as_input_errors(folder):
        return json.loads((folder / name).read_text("utf-8"))


def read_run(folder: Path) -> Run:
    """Read and check the files of a run folder; InputError if they are not those of an evaluation."""
    results, about = read_results(folder), read_results(folder, "run.json")
    with errors_as_input_errors(folder):
        _check(results, about)
        run = Run(folder, results, about)
        if not run.sequences:
            raise ValueError("results.json has no sequence")
        if len(run.gains) != (len(run.sequences) if run.thresholds else 0):
            raise ValueError("each sequence with ground truth has a gains.csv, and no other")
        if any(not {*run.systems} <= {*part.ranks} for part in run.gains.values()):
            raise ValueError("gains.csv lacks a system")
        if "table.csv" in run.tables and not {row[0] for row in run.tables["table.csv"].rows} <= {*run.systems}:
            raise ValueError("table.csv has another system")
        return run


def _check(results: Any, about: Any) -> None:
    """Raise an error unless the values have what pages need."""
    if not isinstance(results, list) or not results:
        raise ValueError("results.json is of no evaluation")
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
def errors_as_input_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, StopIteration, csv.Error) as error:
        raise InputError(f"{folder}: expected the run folder of an evaluation of this version, got other files "
                         f"({type(error).__name__}: {error})") from None  # fmt: skip


def read_table(path: Path, num_texts: int | None) -> Table:
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
    lines = read_csv(path)
    names = [name.removesuffix(" rank") for name in lines[0] if name.endswith(" rank")]
    ranks = {name: np.array([int(line[f"{name} rank"] or 0) for line in lines]) for name in names}
    places = [int(line["place"] or place) for place, line in enumerate(lines)]
    return Gains(tuple(line["query"] for line in lines), np.array(places), ranks)
