"""Reading the files of a run folder."""

import csv
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.runs import LAST, file_names
from mfvpr.report.tables import Table, read_csv
from mfvpr.utils.errors import InputError

_TABLES = (
    "table.csv",
    "differences.csv",
    "confidence.csv",
    "rerank_share.csv",
    "precision_recall.csv",
    "changes.csv",
    "skipped.csv",
)


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
        """Tables of the CSV files, by name."""
        return {name: read_table(self.folder / name) for name in _TABLES if (self.folder / name).exists()}

    @cached_property
    def gains(self) -> Mapping[str, Gains]:
        """Gains by sequence; none without ground truth."""
        if not self.thresholds:
            return {}
        folders = (sequence_folder(self.folder, self.sequences, place) for place in range(len(self.sequences)))
        return {name: _gains(folder / "gains.csv") for name, folder in zip(self.sequences, folders, strict=True)}

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
    """Read the files of a run folder; InputError if they are not those of an evaluation."""
    results, about = read_results(folder), read_results(folder, "run.json")
    with errors_as_input_errors(folder):
        run = Run(folder, results, about)
        if not (run.headline and run.sequences and run.gains.keys() <= {*run.sequences} and "settings" in about):
            raise ValueError("no rows of an evaluation")
        return run


@contextmanager
def errors_as_input_errors(folder: Path) -> Iterator[None]:
    """Turn the errors of files that are not those of an evaluation into an InputError of one line."""
    try:
        yield
    except (ValueError, LookupError, TypeError, AttributeError, OSError, StopIteration, csv.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{folder}: expected the run folder of an evaluation of this version, got other files "
            f"({type(error).__name__}: {' '.join(str(error).split())})"
        ) from None


def read_table(path: Path) -> Table:
    """The table of a CSV file, all cells as text."""
    with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
        header, *rows = csv.reader(file)
    return Table(header, rows)


def _gains(path: Path) -> Gains:
    lines = read_csv(path)
    names = [name.removesuffix(" rank") for name in lines[0] if name.endswith(" rank")]
    ranks = {name: np.array([int(line[f"{name} rank"] or 0) for line in lines]) for name in names}
    places = [int(line["place"] or place) for place, line in enumerate(lines)]
    return Gains(tuple(line["query"] for line in lines), np.array(places), ranks)
