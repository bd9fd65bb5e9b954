"""Evaluate: images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from mfvpr.cli import jobs
from mfvpr.cli.console import warn
from mfvpr.cli.jobs import Inputs, prepare, truth_in_words, with_image_size
from mfvpr.cli.schema import Evaluate
from mfvpr.datasets import Dataset
from mfvpr.datasets.contents import fingerprints
from mfvpr.datasets.ground_truth import middle
from mfvpr.evaluation import Confidence, System, rank_dataset, read_confidences
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.report.evaluations import EvaluationReport, confidence_table, recall_table
from mfvpr.report.figures import query_figures
from mfvpr.report.run_files import RunDescription, ground_truth, heading, write_run_folder
from mfvpr.report.runs import Figure
from mfvpr.systems import assembly
from mfvpr.utils import Stopwatch
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values
from mfvpr.utils.files import expand_user

# Confidences depend on these settings.
_NAMES = ("features", "retrieval", "scorer", "matching", "candidates", "fusion", "previous_queries")


@dataclass(frozen=True)
class Outcome:
    """The results of one evaluation, for its run folder."""

    inputs: Inputs
    report: EvaluationReport
    description: RunDescription
    figures: list[Figure]


def evaluate(settings: Evaluate) -> None:
    """Run all stages, print the table, fill the run folder."""
    settings = with_image_size(settings)
    with jobs.claim(settings.out, settings.dataset["name"]) as folder:
        outcome = evaluation_of(settings)
        report, description = outcome.report, outcome.description
        tables = [recall_table(report.rows())] if report.thresholds else []
        if tables and report.confidences is not None:
            tables.append(confidence_table(report))
        jobs.write_results(
            folder,
            settings,
            ground_truth(report, description),
            text="\n".join([f"{heading(report, description)}\n", *(table.text() for table in tables)]),
            write=lambda new: write_run_folder(new, report, description),
            figures=outcome.figures,
        )
        if page := jobs.report_page(folder):
            print(f"report: {page}")


def evaluation_of(settings: Evaluate) -> Outcome:
    """Evaluate the retrieval, each scorer, alone, and the main scorer fused with the retrieval."""
    rankings = assembly.rankings(settings, settings.previous_queries, settings.sequence)
    watch = Stopwatch()  # errors come before anything slow
    file = None if settings.confidence is None else ConfidenceFile.read(settings.confidence)
    inputs = prepare(settings, watch)
    system, figure_queries = System(inputs.pipeline, **rankings), query_rows(settings.figures, inputs.dataset)
    confidences = file and file.fitting(system, inputs)
    ranked = rank_dataset(inputs.dataset, system, cache=inputs.cache)
    ranked = replace(ranked, seconds={**watch.seconds, **ranked.seconds})
    lacking = None if settings.threshold is None else evidence_against(ranked, inputs.cache)
    report = EvaluationReport(ranked, inputs.thresholds, settings.recall.ks, confidences, settings.threshold, lacking)
    values, scorers = to_values(settings), assembly.describe_settings(settings.scorer)
    description = RunDescription(
        inputs.ground_truth,
        truth_in_words(inputs.ground_truth),
        inputs.contents,
        {name: values[name] for name in _NAMES} | {"scorer": scorers},
        settings.command,
    )
    return Outcome(inputs, report, description, query_figures(report, figure_queries))


def query_rows(queries: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """The rows of queries that are given by row or name; a number of queries as it is."""
    if isinstance(queries, int):
        return queries
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(query, -1) if isinstance(query, str) else query for query in queries]
    for query, row in zip(queries, rows, strict=True):
        if not 0 <= row < len(names):
            expected = f"rows of queries from 0 to {len(names) - 1}, or names such as {dataset.queries.names[0]}"
            raise InputError(f"figures=[{query}]: expected {expected}")
    return list(dict.fromkeys(rows))


@dataclass(frozen=True)
class ConfidenceFile:
    """The confidence of each final score, and the run that it was fitted on."""

    path: str
    systems: Mapping[str, Confidence]
    origin: Mapping[str, Any]

    @classmethod
    def read(cls, path: str) -> "ConfidenceFile":
        """Read the file of an earlier run."""
        return cls(path, *read_confidences(expand_user(path)))

    def of(self, name: str, scorers: Collection[str], settings: Mapping[str, Any], candidates: int) -> Confidence:
        """The confidence of a final score; warns if it was fitted without absent places, or with other settings."""
        if name not in self.systems:
            got = f"{', '.join(self.systems) or 'none'}; evaluate with the same scorer, final and fusion"
            raise InputError(f"confidence={self.path}: expected the confidence of {name}, which decides, got {got}")
        if not self.origin.get("absent_queries"):
            warn(f"confidence={self.path} was fitted without absent places, so that it is too high for them")
        if words := ", ".join(self.other_settings(scorers, settings, candidates)):
            warn(f"confidence={self.path} was fitted with other settings of {words}: it may mean nothing here")
        return self.systems[name]

    def fitting(self, system: System, inputs: Inputs) -> dict[str, Confidence]:
        """The confidences of final scores whose settings fit this run as well as those of the one that decides.

        Warns if the file was fitted on the same images, or with other settings. The file must have that score.
        """
        settings, scores = system.settings or {}, system.final_scores
        candidates = num_candidates(system.pipeline.candidates, inputs.dataset.database)
        self.of(system.headline, scores[system.headline].scorers, settings, candidates)
        before, now = (
            {side: each for side, each in folders.items() if side != "database"}
            for folders in (self.origin.get("data_fingerprint") or {}, fingerprints(inputs.contents))
        )
        if {*before.values()} & {*now.values()}:
            warn(f"confidence={self.path} was fitted on these very images, so that it flatters")
        threshold = inputs.thresholds and [middle(inputs.thresholds), inputs.ground_truth["unit"]]
        if threshold and threshold != self.origin.get("correct_within"):
            warn(f"confidence={self.path} was fitted with other settings of recall: it may mean nothing here")
        known = [name for name in self.systems if name in scores]
        other = {name: {*self.other_settings(scores[name].scorers, settings, candidates)} for name in known}
        return {name: self.systems[name] for name in known if other[name] <= other[system.headline]}

    def other_settings(self, scorers: Collection[str], settings: Mapping[str, Any], candidates: int) -> list[str]:
        """The settings of a run or of a map that were others when the confidence of these scorers was fitted."""
        before = _settings_of(scorers, self.origin.get("settings") or {})
        now = _settings_of(scorers, {**settings, "scorer": assembly.describe_settings(settings["scorer"])})
        names = [name for name in _NAMES if name in now and name != "candidates" and before.get(name) != now[name]]
        return names + ["candidates"] * (self.origin.get("candidates") != candidates)


def _settings_of(names: Collection[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that scores depend on; files of match weights are compared by content, not by name."""
    parts = {name: values for name, values in assembly.by_scorer(settings.get("scorer", {})).items() if name in names}
    no_name = {name: {**values, "weight": None} for name, values in parts.items() if "weight_content" in values}
    return {**settings, "scorer": {**parts, **no_name}}
