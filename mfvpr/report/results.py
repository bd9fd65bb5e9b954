"""Evaluation in one call, and its result: tables, predictions, run folders and a page."""

import itertools
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mfvpr.datasets.datasets import Dataset
from mfvpr.evaluation.dataset_ranking import KS, RankedDataset, rank_dataset
from mfvpr.evaluation.system import System
from mfvpr.report.evaluations import EvaluationReport, recall_table
from mfvpr.report.pages import write_comparison
from mfvpr.report.pages import write_report as write_page
from mfvpr.report.run_files import CandidateLayout, save_run, write_candidates
from mfvpr.report.runs import Table, claim_run_folder, data_frame, file_names, write_table
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError, require_type
from mfvpr.utils.runtime import Runtime

if TYPE_CHECKING:
    from pandas import DataFrame

Thresholds = Sequence[float] | None


class TopPrediction(NamedTuple):
    """The first candidate of a query, by names."""

    dataset: str
    system: str
    sequence: str
    query: str
    prediction: str | None  # None = no candidate
    score: float  # NaN without a candidate
    is_correct: bool | None  # within the middle threshold; None without ground truth


def evaluate(
    data: Dataset | Mapping[str, Dataset],
    system: System | Mapping[str, System],
    *,
    cache: FeatureCache | None = None,
    runtime: Runtime | None = None,
) -> "Result":
    """Rank the candidates of every query, and report how many predictions are correct.

        result = mfvpr.evaluate(data, system, cache=FeatureCache("features"))
        result = mfvpr.evaluate({"night": night, "snow": snow}, {"mine": mine, "paper": paper})

    Args:
        data: a data set, or several by name.
        system: finds, matches, scores and ranks candidates; or several by name.
        cache: where all systems keep features, and with a folder also matches; None = features in memory.
        runtime: devices, memory, progress and messages; None = those of the cache.

    An `InputError` for images or features that cannot be used, or for an invalid result of a part of a system.
    """
    cache = FeatureCache() if cache is None else cache
    if not isinstance(cache, FeatureCache):
        raise InputError(f"cache: expected mfvpr.storage.FeatureCache(folder), got {type(cache).__name__}")
    for each in data.values() if isinstance(data, Mapping) else [data]:
        require_type("data", each, Dataset, 'mfvpr.datasets.folder("day", "night", ground_truth="order")')
    for each in system.values() if isinstance(system, Mapping) else [system]:
        require_type("system", each, System, 'mfvpr.load_system("mfvpr")')
    datasets = data if isinstance(data, Mapping) else {data.name: data}
    systems = system if isinstance(system, Mapping) else {system.headline: system}
    if not datasets or not systems:
        raise InputError("evaluate: expected at least one data set and one system, got none")
    pairs = itertools.product(datasets, systems)
    parts = {(a, b): rank_dataset(datasets[a], systems[b], cache=cache, runtime=runtime) for a, b in pairs}
    return Result(parts, cache)


@dataclass(frozen=True, repr=False)
class Result:
    """Rankings of data sets by systems, the result of `mfvpr.evaluate`.

        print(result.table())
        result.write_report("report.html")

    `thresholds` are largest distances of a correct prediction in the unit of the ground truth, `ks` depths of recall.
    The defaults are those of the programs: 1, 2 and 5 frames or 25 m, and 1, 5 and 10.
    """

    parts: Mapping[tuple[str, str], RankedDataset]  # by names of the data set, and of the system or its final score
    cache: FeatureCache  # of the evaluation

    def __repr__(self) -> str:
        return f"Result({'; '.join(map(', '.join, self._names))})"

    @property
    def only(self) -> RankedDataset:
        """Rankings of the only data set by the only system; InputError if there are several."""
        if len(self.parts) > 1:
            expected = f"expected one data set and one system, got {len(self.parts)} pairs"
            raise InputError(f"result: {expected}; choose one of parts: {', '.join(map(str, self.parts))}")
        return next(iter(self.parts.values()))

    def table(self, thresholds: Thresholds = None, ks: Sequence[int] = KS) -> Table:
        """Recall in %: of every final score of a single system, or of those that decide of several systems.

        Data sets without ground truth are left out; an InputError if there is no other.
        """
        several_data, several_systems = (len(names) > 1 for names in self._names)
        rows = [row for row in self._rows(thresholds, ks) if row["decides"] or not several_systems]
        for row in rows:
            row["system"] = row["system"] if several_systems else row["score"]
            row["data set"] = row["data set"] if several_data else None
        return recall_table(rows)

    def to_latex(self, thresholds: Thresholds = None, ks: Sequence[int] = KS) -> str:
        """`table` as a `tabular` for the booktabs package."""
        return self.table(thresholds, ks).latex()

    def to_pandas(self, thresholds: Thresholds = None, ks: Sequence[int] = KS) -> "DataFrame":
        """Recall from 0 to 1: a row for each data set, system, final score, sequence and threshold; needs pandas."""
        rows = []
        for row in self._rows(thresholds, ks):
            recall_at = row.pop("recall_at")
            rows.append(row | {f"R@{k}": recall for k, recall in recall_at.items()})
        return data_frame(rows)

    @cached_property
    def predictions(self) -> list[TopPrediction]:
        """The top prediction of every query, by the final score that decides of each system."""
        predictions = []
        for names, report in self._reports(None, KS):
            database, ranked = report.ranked.dataset.database.names, report.rankings[report.headline]
            hits = report.hits(report.headline).tolist() if report.thresholds else [None] * len(report.queries)
            firsts = ranked.rows[:, 0].tolist(), ranked.scores[:, 0].tolist()
            for (sequence, query), row, score, is_correct in zip(report.queries, *firsts, hits, strict=True):
                top = (database[row], score) if row >= 0 else (None, math.nan)
                predictions.append(TopPrediction(*names, sequence.name, query, *top, is_correct))
        return predictions

    def save(self, folder: Path | str, thresholds: Thresholds = None, ks: Sequence[int] = KS) -> list[Path]:
        """Write the files of `mfvpr evaluate` but its figures into a new or empty folder, and return the run folders.

        Each of several data sets and systems has a run folder `folder/DATASET/SYSTEM`, beside a joint table.
        """
        folders, several, reports = list[Path](), len(self.parts) > 1, self._reports(thresholds, ks)
        dataset_files, system_files = map(file_names, self._names)
        with claim_run_folder(Path(folder)) as root:
            for (dataset, system), report in reports:
                folders.append(root / dataset_files[dataset] / system_files[system] if several else root)
                save_run(folders[-1], report, self.cache)
            if several and any(report.thresholds for _, report in reports):
                write_table(root, self.table(thresholds, ks), f"recall in %, {self!r}")
        return folders

    def write_predictions(self, path: Path | str, layout: CandidateLayout = "preds") -> None:
        """Write the final ranking of `only`, as `mfvpr.io.write_shortlist`; of each of several sequences, `path/NAME`.

        result.write_predictions("preds")  # a folder of VPR-methods-evaluation, with full paths and correct images
        result.write_predictions("pairs.txt", layout="hloc")
        """
        report = EvaluationReport(self.only)
        files = file_names([sequence.name for sequence in report.sequences])
        for place, sequence in enumerate(report.sequences):
            ranked, part = self.only.systems[report.headline][place], report.parts[place]
            target = Path(path) / files[sequence.name] if len(files) > 1 else Path(path)
            positives = None if report.positives is None else report.positives.take(part)
            sides = sequence.images, report.ranked.dataset.database
            write_candidates(target, ranked.shortlist, *sides, layout, positives)

    def write_report(self, path: Path | str, thresholds: Thresholds = None, ks: Sequence[int] = KS) -> None:
        """Write the page of `mfvpr report`; of several data sets or systems, beside each other."""
        with tempfile.TemporaryDirectory() as root:
            folders = self.save(Path(root) / "run", thresholds, ks)
            write_page(folders[0], Path(path)) if len(folders) == 1 else write_comparison(folders, Path(path))

    @property
    def _names(self) -> tuple[list[str], list[str]]:
        """Names of the data sets, and of the systems."""
        datasets, systems = (list(dict.fromkeys(names)) for names in zip(*self.parts, strict=True))
        return datasets, systems

    def _reports(self, thresholds: Thresholds, ks: Sequence[int]) -> list[tuple[tuple[str, str], EvaluationReport]]:
        return [(names, EvaluationReport(ranked, thresholds or (), ks)) for names, ranked in self.parts.items()]

    def _rows(self, thresholds: Thresholds, ks: Sequence[int]) -> list[dict[str, Any]]:
        """Rows of `EvaluationReport.rows` of all parts; the final score is "score"."""
        rows = []
        for (dataset, system), report in self._reports(thresholds, ks):
            for row in report.rows():
                rows.append({"data set": dataset, "system": system, "score": row.pop("system"), **row})
        return rows
