"""Evaluate: images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mfvpr.cli import jobs
from mfvpr.cli.console import warn
from mfvpr.cli.jobs import Inputs, prepare, truth_in_words
from mfvpr.cli.schema import Evaluate
from mfvpr.core.metrics import hits
from mfvpr.datasets import Dataset
from mfvpr.datasets.contents import fingerprints
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.evaluation import Confidence, System, rank_dataset, read_confidences
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.report.evaluations import EvaluationReport, confidence_table, recall_table
from mfvpr.report.figures import query_figures
from mfvpr.report.pages import write_report
from mfvpr.report.run_files import RunDescription, ground_truth, heading, write_run_folder
from mfvpr.report.runs import Figure
from mfvpr.retrieval.retriever import standardizations, with_standardization
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

    inputs: Inputs[Evaluate]
    report: EvaluationReport
    description: RunDescription
    figures: list[Figure]


def evaluate(settings: Evaluate) -> None:
    """Run all stages, print the table, fill the run folder."""
    with jobs.claim(settings.out, settings.dataset["name"]) as folder:
        outcome = evaluation_of(settings)
        report, description = outcome.report, outcome.description
        tables = [recall_table(report.rows())] if report.thresholds else []
        if tables and report.confidences is not None:
            tables.append(confidence_table(report))
        jobs.write_results(
            folder,
            outcome.inputs.settings,
            ground_truth(report, description),
            text="\n".join([f"{heading(report, description)}\n", *(table.text() for table in tables)]),
            write=lambda new: write_run_folder(new, report, description),
            figures=outcome.figures,
        )
        print(f"report: {write_report(folder)}")


def evaluation_of(settings: Evaluate) -> Outcome:
    """Evaluate the retrieval, each scorer, alone, and the main scorer fused with the retrieval."""
    rankings, watch = assembly.rankings(settings), Stopwatch()
    if settings.confidence is not None:
        read_confidences(expand_user(settings.confidence))  # errors come before anything slow
    inputs = prepare(settings, watch)
    values, figure_queries = to_values(inputs.settings), query_rows(settings.figures, inputs.dataset)
    system = System(inputs.pipeline, **{**rankings, "settings": values})
    confidences = None
    if settings.confidence is not None:
        candidates = num_candidates(system.pipeline.candidates, inputs.dataset.database)
        confidences, origin = fitting_confidences(settings.confidence, system, {**values, "candidates": candidates})
        rules = " and ".join(sorted(standardizations(system.pipeline.retriever, inputs.dataset.sequences)))
        if (rule := confidences[system.headline].standardize) not in (None, rules):
            expected = f"one that was fitted with standardize={rules or 'none'}, got {rule}"
            raise InputError(f"confidence={settings.confidence}: expected {expected}; set retrieval.standardize")
        seen = {side: each for side, each in (origin.get("data_fingerprint") or {}).items() if side != "database"}
        queries = {side: each for side, each in fingerprints(inputs.contents).items() if side != "database"}
        if {*seen.values()} & {*queries.values()}:
            warn(f"confidence={settings.confidence} was fitted on these very images, so that it flatters")
        threshold = inputs.thresholds and [middle(inputs.thresholds), inputs.ground_truth["unit"]]
        if threshold and threshold != origin.get("correct_within"):
            warn(f"confidence={settings.confidence} was fitted with other settings of recall: it may mean nothing here")
    ranked = rank_dataset(inputs.dataset, system, cache=inputs.cache)
    ranked = replace(ranked, seconds={**watch.seconds, **ranked.seconds})
    lacking = None if settings.threshold is None else evidence_against(ranked, inputs.cache)
    report = EvaluationReport(ranked, inputs.thresholds, settings.recall.ks, confidences, settings.threshold, lacking)
    described = {name: values[name] for name in _NAMES} | {"scorer": assembly.describe_settings(settings.scorer)}
    truth, remark = inputs.ground_truth, running_in_words(report, inputs)
    of_run = truth, truth_in_words(truth), inputs.contents, described, settings.command
    description = RunDescription(*of_run, remark=remark)
    return Outcome(inputs, report, description, query_figures(report, figure_queries))


def running_in_words(report: EvaluationReport, inputs: Inputs[Evaluate]) -> str:
    """Recall of the retrieval without later queries, where its standardization looks at all of a drive."""
    dataset, retriever = report.ranked.dataset, inputs.pipeline.retriever
    if not report.thresholds or "drive" not in standardizations(retriever, dataset.sequences):
        return ""
    running, correct = with_standardization(retriever, lambda _: "running"), list[np.ndarray]()
    for sequence, positives in zip(dataset.sequences, report.ranked.positives(report.threshold), strict=True):
        shortlist = running.shortlist(sequence, dataset.database, 1, inputs.cache).candidates
        correct.append(hits(shortlist.indices, positives))
    recall = 100 * np.concatenate(correct).mean()
    within = threshold_words(inputs.ground_truth["unit"], report.threshold)
    return f"; a robot, which knows earlier queries only, has R@1{within} {recall:.1f} by retrieval (running)"


def query_rows(queries: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """The rows of queries that are given by row or name; a number of queries as it is."""
    if isinstance(queries, int):
        return queries
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(query, -1) if isinstance(query, str) else query for query in queries]
    for query, row in zip(queries, rows, strict=True):
        if not 0 <= row < len(names):
            expected = f"rows from 0 to {len(names) - 1}, or names such as {next(iter(names))}"
            raise InputError(f"figures=[{query}]: expected {expected}")
    return list(dict.fromkeys(rows))


def fitting_confidences(
    path: str, system: System, settings: Mapping[str, Any]
) -> tuple[dict[str, Confidence], dict[str, Any]]:
    """The confidences in a file whose settings fit as well as those of the score that decides, and their origin.

    The file must have the score that decides. Warns if it was fitted without absent places, or with other `settings`.
    """
    fitted, origin = read_confidences(expand_user(path))
    scores, deciding = system.final_scores, system.headline
    if deciding not in fitted:
        got = ", ".join(fitted) or "none"
        raise InputError(f"confidence={path}: expected the confidence of {deciding}, which decides, got {got}")
    before = {**(origin.get("settings") or {}), "candidates": origin.get("candidates")}
    now = {**settings, "scorer": assembly.describe_settings(settings["scorer"])}
    differing = {}
    for name in (name for name in fitted if name in scores):
        both = [_settings_of(scores[name].scorers, each) for each in (before, now)]
        differing[name] = [each for each in _NAMES if each in now and both[0].get(each) != both[1][each]]
    if not origin.get("absent_queries"):
        warn(f"confidence={path} was fitted without absent places, so that it is too high for them")
    if words := ", ".join(differing[deciding]):
        warn(f"confidence={path} was fitted with other settings of {words}: it may mean nothing here")
    return {name: fitted[name] for name in differing if {*differing[name]} <= {*differing[deciding]}}, origin


def _settings_of(names: Collection[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that scores depend on; files of match weights are compared by content, not by name."""
    parts = {
        name: values
        for name, values in assembly.by_choice("scorer", settings.get("scorer", {})).items()
        if name in names
    }
    no_name = {name: {**values, "weight": None} for name, values in parts.items() if "weight_content" in values}
    return {**settings, "scorer": {**parts, **no_name}}
