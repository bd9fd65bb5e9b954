"""Evaluate: images -> features -> shortlist and matches -> scores -> rankings -> recall, in a run folder."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mfvpr.cli import confidences, run_folder, stages, truth
from mfvpr.cli.stages import Images, Tools
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import published_differences
from mfvpr.datasets.truth import Unit
from mfvpr.evaluation import Shard, evaluation, fill_shard
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.features import Source
from mfvpr.report import runs
from mfvpr.report.confidences import CalibratedPredictions, confidence_figures, confidence_table, write_confidence
from mfvpr.report.differences import write_gains
from mfvpr.report.evaluations import EvaluationReport, query_figures, recall_table, write_rankings, write_skipped
from mfvpr.report.shifts import write_shifts
from mfvpr.reranking import Fusion
from mfvpr.reranking.results import COHORT, FRAMES, RETRIEVAL
from mfvpr.scoring import HistogramOfShifts
from mfvpr.storage.extraction import open_sinks
from mfvpr.systems import assembly
from mfvpr.systems.settings import SettingsError
from mfvpr.utils import Stopwatch
from mfvpr.utils.versions import versions

_THRESHOLD_NAMES: dict[Unit, str] = {"frames": "tolerance", "m": "radius"}


@dataclass(frozen=True)
class Outcome:
    """The results of one evaluation; parameters by system, and the histogram if it decides."""

    settings: dict[str, Any]
    images: Images
    tools: Tools
    report: EvaluationReport
    calibrated: CalibratedPredictions
    parameters: dict[str, dict[str, Any]]
    histogram: HistogramOfShifts | None
    figures: list[runs.Figure]


def evaluate(settings: dict[str, Any]) -> None:
    """Run all stages, print the table, fill the run folder; a shard fills the cache only."""
    if settings["shard"] is not None:
        _fill_shard(settings)
        return
    with run_folder.claim(settings) as folder:
        outcome = evaluation_of(settings)
        run_folder.write_results(
            folder, settings, ground_truth(outcome), text=text(outcome),
            write=lambda new: write_run_folder(new, outcome), figures=outcome.figures,
        )  # fmt: skip
        if page := run_folder.report_page(folder):
            print(f"report: {page}")


def _fill_shard(settings: dict[str, Any]) -> None:
    """Do the part of a shard, and print what is done, and what to do next."""
    shard = Shard.parse(settings["shard"])
    tools, images = stages.prepare(settings, Stopwatch())
    print(fill_shard(images.dataset, assembly.system(settings, tools.pipeline), tools.cache, shard))


def evaluation_of(settings: dict[str, Any]) -> Outcome:
    """Evaluate the retrieval, each scorer, alone and with a cohort, and the main scorer fused with the retrieval."""
    scorers, watch, confidence = assembly.scorers(settings["scorer"]), Stopwatch(), confidences.read_file(settings)
    main = assembly.main_scorer(scorers)
    assembly.fusion(settings).check(main, scorers)  # before anything slow
    tools, images = stages.prepare(settings, watch)
    system, figure_queries = assembly.system(settings, tools.pipeline), query_rows(settings["figures"], images.dataset)
    headline = system.headline
    confidence = confidences.check_confidence(confidence, headline, settings, images)
    result = evaluation.evaluate(images.dataset, system, cache=tools.cache)
    result = replace(result, seconds={**watch.seconds, **result.seconds})
    parameters = _parameters(settings, main, system.fused)
    for name, correlation in system.correlated.items():
        parameters[f"{name} + {FRAMES}"] = parameters[name] | asdict(correlation)
    thresholds = truth.thresholds(settings, images.dataset.sequences[0].truth)
    report = EvaluationReport(result, thresholds, sorted(set(settings["recall"]["ks"])), headline)
    histogram = scorers.get("histogram")
    histogram = histogram if isinstance(histogram, HistogramOfShifts) else None
    calibrated = CalibratedPredictions(report, confidence and confidence.systems, settings["threshold"])
    extractor, refused = tools.pipeline.extractor, calibrated.refused_of_headline
    all_figures = query_figures(report, extractor, figure_queries, refused, histogram)
    all_figures += confidence_figures(calibrated) if figure_queries else []
    deciding = histogram if main == "histogram" else None
    return Outcome(settings, images, tools, report, calibrated, parameters, deciding, all_figures)


def _parameters(settings: dict[str, Any], main: str, fusions: Mapping[str, Fusion]) -> dict[str, dict[str, Any]]:
    """Parameters by system: retrieval, scorers, scorers with a cohort, fusions."""
    scorers = assembly.describe_settings(settings["scorer"])
    if (cohort := settings["cohort"]) is not None:
        scorers |= {f"{name} + {COHORT}": values | {"cohort": cohort} for name, values in scorers.items()}
    members = fusions[main].members(main)
    member_parameters = scorers[main] if members == [main] else {name: scorers[name] for name in members}
    fused = {
        fusion.system(name): (member_parameters if name == main else scorers[name]) | settings["fusion"]
        for name, fusion in fusions.items()
    }
    return {RETRIEVAL: {}, **scorers, **fused}


def ground_truth(outcome: Outcome) -> dict[str, Any]:
    """Description and fingerprint of the ground truth."""
    dataset, thresholds = outcome.images.dataset, outcome.report.thresholds
    return truth.describe(outcome.settings, dataset) | {"fingerprint": truth.positives_fingerprint(dataset, thresholds)}


def text(outcome: Outcome) -> str:
    """Heading and tables for the terminal."""
    tables = [recall_table(outcome.report)] if outcome.report.thresholds else []
    if tables and outcome.settings["confidence"]:
        tables.append(confidence_table(outcome.calibrated))
    return "\n".join([f"{heading(outcome)}\n", *(table.text() for table in tables)])


def heading(outcome: Outcome) -> str:
    """Data set, numbers of images, retrieval, features and ground truth in one line."""
    settings, dataset, matched = outcome.settings, outcome.images.dataset, outcome.report.result.matched
    queries = sum(len(sequence.images) for sequence in dataset.sequences)
    bad_queries = sum(len(sequence.bad_queries) for sequence in matched)
    bad_database = len({row for sequence in matched for row in sequence.bad_database})
    matching = settings["matching"]
    check = f"cross_check={matching['cross_check']}" if "cross_check" in matching else matching["name"]
    check = "" if check == "cross_check=mutual" else f", {check}"
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {queries} queries{several}{_skip_note(bad_queries)}, "
        f"{len(dataset.database)} database images{_skip_note(bad_database)}, "
        f"{num_candidates(settings['candidates'], dataset.database)} candidates ({settings['retrieval']['name']}), "
        f"{settings['features']['name']} features{check}; {truth.in_words(truth.describe(settings, dataset))}"
    )


def _skip_note(number: int) -> str:
    return f" ({number} skipped)" if number else ""


def write_run_folder(folder: Path, outcome: Outcome) -> None:
    """Write all files of a run folder but the figures."""
    runs.write_json(folder / "results.json", result_rows(outcome))
    if outcome.report.thresholds:
        runs.write_table(folder, recall_table(outcome.report), heading(outcome))
    write_rankings(folder, outcome.report, outcome.calibrated.refused_of_headline)
    write_gains(folder, outcome.report)
    provenance = confidences.provenance(outcome.settings, outcome.images, outcome.report)
    write_confidence(folder, outcome.calibrated, provenance)
    if outcome.histogram is not None:
        write_shifts(folder, outcome.report, outcome.histogram, outcome.calibrated.refused_of_headline)
    write_skipped(folder, outcome.report.result)


def result_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """One row per system and threshold, and per sequence if there are several."""
    report, settings, dataset = outcome.report, outcome.settings, outcome.images.dataset
    common = {
        "retrieval": settings["retrieval"],
        "features": settings["features"],
        "matching": settings["matching"],
        "candidates": num_candidates(settings["candidates"], dataset.database),
        "queries": sum(len(sequence.images) for sequence in dataset.sequences),
        "database": len(dataset.database),
        "dataset": dataset.name,
        "incomplete": list(published_differences(dataset)),
        "data_fingerprint": outcome.images.fingerprints,
        "ground_truth": ground_truth(outcome),
        "reading": outcome.images.reading,
        "bytes_per_image": _bytes_per_image(outcome),
        "seconds": report.result.seconds,
        "versions": versions(),
    }
    rows = []
    for name, parameters in outcome.parameters.items():
        scorers = [part for part in name.split(" + ") if part not in (COHORT, RETRIEVAL, FRAMES)]
        system = {
            "system": name,
            "scorer": " + ".join(scorers) or "none",
            "decides": name == report.headline,
            "parameters": parameters,
        }
        rows += [system | recall | common for recall in _recalls(report, name)]
    return rows


def _bytes_per_image(outcome: Outcome) -> int | None:
    """Expected bytes of an image's features on disk; None for imported features, which are not stored."""
    extractor = outcome.tools.pipeline.extractor
    if isinstance(extractor, Source):
        return None
    return sum(sink.forecast(1) for sink in open_sinks(None, extractor, {}, []))


def _recalls(report: EvaluationReport, system: str) -> list[dict[str, Any]]:
    """Threshold and recall by K; for several sequences, of each sequence and their mean."""
    if not report.thresholds:
        return [{"recall_at": {}}]
    known = report.sequences[0].truth
    name = _THRESHOLD_NAMES.get(known.unit) if known else None
    several = len(report.sequences) > 1
    return [
        ({"sequence": sequence} if several else {})
        | ({name: threshold} if name else {})
        | {"recall_at": {str(k): round(float(value), 6) for k, value in zip(report.ks, recall[index], strict=True)}}
        for sequence, recall in report.parts(system)
        for index, threshold in enumerate(report.thresholds)
    ]


def query_rows(queries: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """The rows of queries that are given by row or name; a number of queries as it is."""
    if isinstance(queries, int):
        return queries
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(query, -1) if isinstance(query, str) else query for query in queries]
    for query, row in zip(queries, rows, strict=True):
        if not 0 <= row < len(names):
            raise SettingsError(
                f"figures=[{query}]: expected rows of queries from 0 to {len(names) - 1}, or names such as "
                f"{dataset.queries.names[0]}"
            )
    return list(dict.fromkeys(rows))
