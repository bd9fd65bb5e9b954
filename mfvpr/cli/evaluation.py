"""Evaluate: images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""

from dataclasses import dataclass, replace

from mfvpr.cli import confidences, run_folder
from mfvpr.cli.inputs import Inputs, prepare, truth_in_words, with_image_size
from mfvpr.cli.schema import Evaluate
from mfvpr.datasets import Dataset
from mfvpr.evaluation import System, rank_dataset
from mfvpr.evaluation.evidence import evidence_against
from mfvpr.report.evaluations import EvaluationReport, confidence_table, recall_table
from mfvpr.report.figures import query_figures, reliability_figures
from mfvpr.report.run_files import RunDescription, ground_truth, heading, parameters, write_run_folder
from mfvpr.report.runs import Figure
from mfvpr.systems import assembly
from mfvpr.utils import Stopwatch
from mfvpr.utils.errors import InputError
from mfvpr.utils.fields import to_values


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
    with run_folder.claim(settings.out, settings.dataset["name"]) as folder:
        outcome = evaluation_of(settings)
        report, description = outcome.report, outcome.description
        tables = [recall_table(report.rows())] if report.thresholds else []
        if tables and report.confidences is not None:
            tables.append(confidence_table(report))
        run_folder.write_results(
            folder,
            settings,
            ground_truth(report, description),
            text="\n".join([f"{heading(report, description)}\n", *(table.text() for table in tables)]),
            write=lambda new: write_run_folder(new, report, description),
            figures=outcome.figures,
        )
        if page := run_folder.report_page(folder):
            print(f"report: {page}")


def evaluation_of(settings: Evaluate) -> Outcome:
    """Evaluate the retrieval, each scorer, alone, and the main scorer fused with the retrieval."""
    rankings = assembly.rankings(settings, settings.previous_queries, settings.sequence)
    watch = Stopwatch()  # errors come before anything slow
    confidence = None if settings.confidence is None else confidences.read_file(settings.confidence)
    inputs = prepare(settings, watch)
    system, figure_queries = System(inputs.pipeline, **rankings), query_rows(settings.figures, inputs.dataset)
    confidence = confidence and confidences.check_confidence(confidence, system, inputs)
    ranked = rank_dataset(inputs.dataset, system, cache=inputs.cache)
    ranked = replace(ranked, seconds={**watch.seconds, **ranked.seconds})
    lacking = None if settings.threshold is None else evidence_against(ranked, inputs.cache)
    systems, ks = confidence and confidence.systems, settings.recall.ks
    report = EvaluationReport(ranked, inputs.thresholds, ks, systems, settings.threshold, lacking)
    figures = query_figures(report, figure_queries) + (reliability_figures(report) if figure_queries else [])
    return Outcome(inputs, report, _describe(settings, inputs, system), figures)


def _describe(settings: Evaluate, inputs: Inputs, system: System) -> RunDescription:
    """The settings of the run, for its folder."""
    scorers = assembly.describe_settings(settings.scorer)
    return RunDescription(
        {"retrieval": settings.retrieval, "features": settings.features, "matching": settings.matching},
        parameters(system.final_scores.values(), scorers, to_values(settings.fusion)),
        inputs.ground_truth,
        truth_in_words(inputs.ground_truth),
        inputs.contents,
        confidences.scoring_settings(to_values(settings)),
        settings.command,
    )


def query_rows(queries: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """The rows of queries that are given by row or name; a number of queries as it is."""
    if isinstance(queries, int):
        return queries
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(query, -1) if isinstance(query, str) else query for query in queries]
    for query, row in zip(queries, rows, strict=True):
        if not 0 <= row < len(names):
            raise InputError(
                f"figures=[{query}]: expected rows of queries from 0 to {len(names) - 1}, or names such as "
                f"{dataset.queries.names[0]}"
            )
    return list(dict.fromkeys(rows))
