"""Reading the files of a run folder."""

import csv
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from mfvpr.datasets.datasets import MEANS
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.evaluation.statistics import Estimate, estimate
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.runs import LAST, file_names
from mfvpr.report.tables import Table, read_csv, read_table
from mfvpr.utils.errors import InputError

_TABLES = ("table", "differences", "confidence", "rerank_share", "precision_recall")  # with ground truth
_MORE_TABLES = ("changes", "skipped")  # of some runs


class Gains(NamedTuple):
    """Ranks of the first correct candidates for the Q queries of one sequence, or of several, one after the other.

    `queries` are names, `places` are along the map, `ranks` are by system, 0 = no candidate is correct.
    """

    queries: Sequence[str]
    places: Int[np.ndarray, " queries"]
    ranks: Mapping[str, Int[np.ndarray, " queries"]]

    def hits(self, system: str, k: int = 1) -> Bool[np.ndarray, " queries"]:
        """In the order of the path, whether one of the first k candidates is correct."""
        ranks = self.ranks[system]
        return ((ranks > 0) & (ranks <= k))[np.argsort(self.places, kind="stable")]

    def recall(self, system: str) -> Estimate:
        """Recall at 1 and its 95 % interval."""
        return estimate(self.hits(system))


@dataclass(frozen=True)
class Run:
    """The content of a run folder.

    Attributes:
        results: rows of `results.json`.
        about: the content of `run.json`.
        tables: of CSV files, by name without suffix.
        gains: by sequence; none without ground truth.
    """

    folder: Path
    results: Sequence[Mapping[str, Any]]
    about: Mapping[str, Any]
    tables: Mapping[str, Table]
    gains: Mapping[str, Gains]

    @property
    def common(self) -> Mapping[str, Any]:
        """Values that all rows of the results share: the data set, seconds, versions and so on."""
        return self.results[0]

    @property
    def systems(self) -> list[str]:
        """Names of the systems, in the order of the results."""
        return list(dict.fromkeys(row["system"] for row in self.results))

    @property
    def headline(self) -> str:
        """The system that decides."""
        return next(row["system"] for row in self.results if row["decides"])

    @property
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
    def all_gains(self) -> Gains:
        """Gains of all sequences, with ground truth."""
        parts = [*self.gains.values()]
        queries = [query for gains in parts for query in gains.queries]
        ranks = {name: np.concatenate([gains.ranks[name] for gains in parts]) for name in self.systems}
        return Gains(queries, np.concatenate([gains.places for gains in parts]), ranks)

    def predictions(self) -> Iterator[dict[str, str]]:
        """The first predictions of all systems for each query, those of the system that decides first.

        A row has texts: `system`, `sequence`, `query`, `prediction` and `score`, empty without one; `outcome`, which
        is "correct", "incorrect", or "best" without ground truth; and `rank` of the first correct candidate, empty if
        there is none or if it is unknown.
        """
        systems, files = sorted(self.systems, key=lambda name: name != self.headline), file_names(self.systems)
        for system, (place, sequence) in itertools.product(systems, enumerate(self.sequences)):
            folder = sequence_folder(self.folder, self.sequences, place) / "predictions"
            with reading_run(self.folder):
                first = {row["query"]: row for row in read_csv(folder / f"{files[system]}.csv") if row["rank"] == "1"}
            ranks: Mapping[str, int | None] = dict.fromkeys(first)
            if gains := self.gains.get(sequence):
                ranks = dict(zip(gains.queries, gains.ranks[system].tolist(), strict=True))
            for query, rank in ranks.items():
                row, outcome = first.get(query, {}), "best" if rank is None else "correct" if rank == 1 else "incorrect"
                names = {"system": system, "sequence": sequence, "query": query, "prediction": row.get("database", "")}
                yield names | {"score": row.get("score", ""), "outcome": outcome, "rank": str(rank or "")}


def read_results(folder: Path, name: str = LAST) -> Any:
    """The content of a JSON file of a run folder; InputError if there is none."""
    if not (folder / name).is_file():
        raise InputError(f"{folder}: expected a run folder, got one without {name}")
    with reading_run(folder):
        return json.loads((folder / name).read_text("utf-8"))


def read_run(folder: Path) -> Run:
    """Read the files of a run folder; InputError if they are not those of an evaluation."""
    results, about = read_results(folder), read_results(folder, "run.json")
    with reading_run(folder):
        run, gains = Run(folder, results, about, {}, {}), {}
        names = [name for name in _MORE_TABLES if (folder / f"{name}.csv").exists()]
        names += _TABLES if run.thresholds else ()
        tables = {name: read_table(folder / f"{name}.csv") for name in names}
        for place, name in enumerate(run.sequences if run.thresholds else ()):
            lines = read_csv(sequence_folder(folder, run.sequences, place) / "gains.csv")
            systems = [column.removesuffix(" rank") for column in lines[0] if column.endswith(" rank")]
            ranks = {system: np.array([int(line[f"{system} rank"] or 0) for line in lines]) for system in systems}
            places = np.array([int(line["place"] or number) for number, line in enumerate(lines)])
            gains[name] = Gains([line["query"] for line in lines], places, ranks)
        return replace(run, tables=tables, gains=gains)


@contextmanager
def reading_run(folder: Path) -> Iterator[None]:
    """Turn the errors of files that are not those of an evaluation into an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, OSError, csv.Error) as error:
        raise InputError(
            f"{folder}: expected the run folder of an evaluation of this version, got other files "
            f"({type(error).__name__}: {' '.join(str(error).split())})"
        ) from None
