"""Files of the run folder of an evaluation: of `mfvpr evaluate`, and of `save` of a result in Python."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.contents import Contents, fingerprints, readings
from mfvpr.datasets.published import published_differences
from mfvpr.datasets.truth import middle
from mfvpr.evaluation.fusion import FinalScore, Fusion
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.features.extractor import Source
from mfvpr.report.confidences import write_confidence
from mfvpr.report.evaluation_files import write_changes, write_gains, write_rankings, write_skipped
from mfvpr.report.evaluations import EvaluationReport, recall_table
from mfvpr.report.runs import write_about, write_json, write_table, writing
from mfvpr.report.tables import format_number, write_csv
from mfvpr.storage.extraction import open_sinks
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.versions import versions

SHIFTS = ("query", "prediction", "shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "width",
          "height")  # of shifts.csv  # fmt: skip


@dataclass(frozen=True)
class RunDescription:
    """Settings of an evaluation, as JSON values for its run folder.

    Attributes:
        stages: name and settings of "retrieval", "features" and "matching".
        parameters: by final score.
        truth: kind, files, unit and thresholds of the ground truth; `truth_words` say the same in headings.
        contents: of the image files, by side.
        settings: that scores depend on.
    """

    stages: Mapping[str, Mapping[str, Any]]
    parameters: Mapping[str, Mapping[str, Any]]
    truth: Mapping[str, Any]
    truth_words: str
    contents: Mapping[str, Contents]
    settings: Mapping[str, Any]
    command: str | None = None


def parameters(
    final_scores: Iterable[FinalScore],
    scorers: Mapping[str, Mapping[str, Any]],
    fusion: dict[str, Any] | None = None,
) -> dict[str, dict[str, Any]]:
    """Parameters by final score, from those of scorers by name, and of all fusions; None = the fields of each."""
    by_name: dict[str, dict[str, Any]] = {}
    for score in final_scores:
        values: dict[str, Any] = by_name[score.base] if score.base else {**scorers.get(score.name, {})}
        if isinstance(score.step, Fusion) and len(score.scorers) > 1:
            values = {name: scorers[name] for name in score.scorers}
        if score.step is not None:
            values = values | (fusion if fusion and isinstance(score.step, Fusion) else asdict(score.step))
        by_name[score.name] = values
    return by_name


def heading(report: EvaluationReport, description: RunDescription) -> str:
    """Data set, numbers of images, retrieval, features and ground truth in one line."""
    dataset, matched, stages = report.ranked.dataset, report.ranked.matched, description.stages
    bad_queries = sum(len(sequence.bad_queries) for sequence in matched)
    bad_database = len({row for sequence in matched for row in sequence.bad_database})
    matching = stages["matching"]
    check = f"cross_check={matching['cross_check']}" if "cross_check" in matching else matching["name"]
    check = "" if check in ("cross_check=mutual", "import", "MatchFiles") else f", {check}"
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {report.num_queries} queries{several}{_skip_note(bad_queries)}, "
        f"{len(dataset.database)} database images{_skip_note(bad_database)}, "
        f"{_num_candidates(report)} candidates ({stages['retrieval']['name']}), "
        f"{matched_content(stages)}{check}; {description.truth_words}"
    )


def matched_content(stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Words for the content that the matches come from: features, images, or files."""
    matching = stages["matching"]
    if matching.get("name") in ("import", "MatchFiles"):
        return "imported matches"
    is_of_images = matching.get("inputs") == "images"
    return f"matches of {matching['name']}" if is_of_images else f"{stages['features']['name']} features"


def _skip_note(number: int) -> str:
    return f" ({number} skipped)" if number else ""


def write_run_folder(folder: Path, report: EvaluationReport, description: RunDescription) -> None:
    """Write all files of a run folder but run.json and the figures."""
    write_json(folder / "results.json", result_rows(report, description))
    if report.thresholds:
        write_table(folder, recall_table(report), heading(report, description))
    write_rankings(folder, report)
    write_gains(folder, report)
    write_confidence(folder, report, _provenance(report, description))
    if report.histogram is not None:
        write_shifts(folder, report, report.histogram)
    write_changes(folder, report)
    write_skipped(folder, report.ranked)


def write_shifts(folder: Path, evaluation: EvaluationReport, scorer: HistogramOfShifts) -> None:
    """Write `shifts.csv` of every sequence: shifts of the headline's first predictions, candidate minus query, px.

    A line has the refined dominant shift of the query's middle, and its 95 % interval; empty if no match votes. Their
    px are those of the resized images, whose width and height follow. Queries that are refused have no line, features
    of several scales no file.
    """
    names = evaluation.ranked.dataset.database.names
    sequences = zip(evaluation.ranked.matched, evaluation.ranked.systems[evaluation.headline], strict=True)
    for place, (matched, ranked) in enumerate(sequences):
        match_set = matched.by_scale
        if isinstance(match_set, Scales):
            continue
        predictions = ranked.rows[:, 0]
        queries = np.flatnonzero((predictions >= 0) & ~evaluation.refused[place])
        places = np.argmax(matched.candidates.indices[queries] == predictions[queries, None], axis=1)
        shifts, intervals, sizes = dominant_shifts(scorer, match_set, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), sizes], axis=1)
        lines = [
            [matched.sequence.images.names[query], names[predictions[query]],
             *("" if np.isnan(value) else format_number(value) for value in row)]
            for query, row in zip(queries, numbers, strict=True)
        ]  # fmt: skip
        write_csv(evaluation.folder(folder, place) / "shifts.csv", SHIFTS, lines)


def ground_truth(report: EvaluationReport, description: RunDescription) -> dict[str, Any]:
    """Description and fingerprint of the ground truth."""
    fingerprint = report.ranked.dataset.positives_fingerprint(report.thresholds)
    return {**description.truth, "fingerprint": fingerprint}


def result_rows(report: EvaluationReport, description: RunDescription) -> list[dict[str, Any]]:
    """One row per final score and threshold, and per sequence if there are several."""
    dataset = report.ranked.dataset
    common = {
        **description.stages,
        "candidates": _num_candidates(report),
        "queries": report.num_queries,
        "database": len(dataset.database),
        "dataset": dataset.name,
        "incomplete": list(published_differences(dataset)),
        "data_fingerprint": fingerprints(description.contents),
        "ground_truth": ground_truth(report, description),
        "reading": readings(description.contents),
        "bytes_per_image": _bytes_per_image(report),
        "seconds": report.ranked.seconds,
        "versions": versions(),
    }
    rows = []
    for name, score in report.ranked.system.final_scores.items():
        system = {
            "system": name,
            "scorer": " + ".join(score.scorers) or "none",
            "decides": name == report.headline,
            "parameters": description.parameters[name],
        }
        rows += [system | recall | common for recall in report.rows(name)]
    return rows


def _provenance(report: EvaluationReport, description: RunDescription) -> dict[str, Any]:
    """The data and settings that confidences are fitted with, for their file."""
    truth = report.sequences[0].truth
    return {
        "dataset": report.ranked.dataset.name,
        "data_fingerprint": fingerprints(description.contents),
        "queries": report.num_queries,
        "absent_queries": report.calibration[report.headline].num_absent if truth else 0,
        "correct_within": [middle(report.thresholds), truth.unit] if truth else None,
        "candidates": _num_candidates(report),
        "ground_truth": description.truth,
        "settings": description.settings,
        "command": description.command,
        "versions": versions(),
    }


def save_run(folder: Path, report: EvaluationReport, cache: FeatureCache) -> None:
    """Write the run folder of an evaluation in Python, whose settings are the recipes of its values."""
    dataset, system, truth = report.ranked.dataset, report.ranked.system, report.sequences[0].truth
    pipeline, several = system.pipeline, len(dataset.sequences) > 1
    known, words = {"kind": "none"}, "no ground truth: rankings only"
    if truth is not None:
        known = {"kind": type(truth).__name__, "unit": truth.unit, "thresholds": report.thresholds}
        words = f"recall in %, ground truth: {known['kind']}"
    folders = {f"query {each.name}" if several else "query": each.images for each in dataset.sequences}
    folders = {"database": dataset.database, **folders}
    parts = {"retrieval": pipeline.retriever, "features": pipeline.extractor, "matching": pipeline.matcher}
    stages = {name: _values(part, cache) for name, part in parts.items()}
    scorers = {name: _values(scorer, cache) for name, scorer in system.scorers.items()}
    roots = {side: str(images.root) for side, images in folders.items()}
    settings = {
        "dataset": {"name": dataset.name, **roots}, **stages, "candidates": pipeline.candidates, "scorer": scorers,
        "ties": system.ties, "final": system.headline,
    }  # fmt: skip
    contents = {side: cache.recipes.contents(images) for side, images in folders.items()}
    by_score = parameters(system.final_scores.values(), scorers)
    description = RunDescription(stages, by_score, known, words, contents, settings)
    with writing(folder) as new:
        write_run_folder(new, report, description)
        write_about(new, settings, ground_truth(report, description))


def _values(part: Any, cache: FeatureCache) -> dict[str, Any]:
    """The name and the recipe of a part of a system, which may be a function without recipe."""
    name = getattr(part, "__name__", type(part).__name__)
    try:
        return {"name": name, **cache.recipes.of(part)}
    except TypeError:
        return {"name": name}


def _num_candidates(report: EvaluationReport) -> int:
    return num_candidates(report.ranked.system.pipeline.candidates, report.ranked.dataset.database)


def _bytes_per_image(report: EvaluationReport) -> int | None:
    """Expected bytes of an image's features on disk; None for imported features, which are not stored."""
    extractor = report.ranked.system.pipeline.extractor
    if isinstance(extractor, Source):
        return None
    return sum(sink.forecast(1) for sink in open_sinks(None, extractor, {}, []))
