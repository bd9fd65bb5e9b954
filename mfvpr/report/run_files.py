"""Files of the run folder of an evaluation: of `mfvpr evaluate`, and of `save` of a result in Python."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.contents import Contents, fingerprints, readings
from mfvpr.datasets.ground_truth import middle
from mfvpr.datasets.positives import stack_positives
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.confidence import write_confidences
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.protocol import places_along_path
from mfvpr.evaluation.rankings import RETRIEVAL, FinalScore, Fusion, Ranked
from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.evaluation.statistics import mcnemar, path_test
from mfvpr.report.evaluations import (
    NO_PLACE,
    SHARES,
    EvaluationReport,
    confidence_table,
    recall_table,
    recalls_by_share,
)
from mfvpr.report.runs import file_names, write_about, write_json, write_table, writing
from mfvpr.report.tables import format_number, write_csv
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.fingerprints import versions

SHIFTS = ("shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "width", "height")  # px, of shifts.csv


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
    skipped = [f" ({number} skipped)" if number else "" for number in (bad_queries, bad_database)]
    matching = stages["matching"]
    check = f"cross_check={matching['cross_check']}" if "cross_check" in matching else matching["name"]
    check = "" if check in ("cross_check=mutual", "import", "MatchFiles") else f", {check}"
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {report.num_queries} queries{several}{skipped[0]}, "
        f"{len(dataset.database)} database images{skipped[1]}, "
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


def _num_candidates(report: EvaluationReport) -> int:
    return num_candidates(report.ranked.system.pipeline.candidates, report.ranked.dataset.database)


def ground_truth(report: EvaluationReport, description: RunDescription) -> dict[str, Any]:
    """Description and fingerprint of the ground truth."""
    fingerprint = report.ranked.dataset.positives_fingerprint(report.thresholds)
    return {**description.truth, "fingerprint": fingerprint}


def save_run(folder: Path, report: EvaluationReport, cache: FeatureCache) -> None:
    """Write the run folder of an evaluation in Python, whose settings are the recipes of its values."""

    def recipe(part: Any) -> dict[str, Any]:
        name = {"name": getattr(part, "__name__", type(part).__name__)}
        try:
            return name | cache.recipes.of(part)
        except TypeError:  # a function without recipe
            return name

    dataset, system, truth = report.ranked.dataset, report.ranked.system, report.sequences[0].truth
    pipeline, several = system.pipeline, len(dataset.sequences) > 1
    known, words = {"kind": "none"}, "no ground truth: rankings only"
    if truth is not None:
        known = {"kind": type(truth).__name__, "unit": truth.unit, "thresholds": report.thresholds}
        words = f"recall in %, ground truth: {known['kind']}"
    folders = {f"query {each.name}" if several else "query": each.images for each in dataset.sequences}
    folders = {"database": dataset.database, **folders}
    parts = {"retrieval": pipeline.retriever, "features": pipeline.extractor, "matching": pipeline.matcher}
    stages = {name: recipe(part) for name, part in parts.items()}
    scorers = {name: recipe(scorer) for name, scorer in system.scorers.items()}
    settings = {
        "dataset": {"name": dataset.name} | {side: str(images.root) for side, images in folders.items()},
        **stages,
        "candidates": pipeline.candidates,
        "scorer": scorers,
        "ties": system.ties,
        "final": system.headline,
    }
    contents = {side: cache.recipes.contents(images) for side, images in folders.items()}
    by_score = parameters(system.final_scores.values(), scorers)
    description = RunDescription(stages, by_score, known, words, contents, settings)
    with writing(folder) as new:
        write_run_folder(new, report, description)
        write_about(new, settings, ground_truth(report, description))


def write_run_folder(folder: Path, report: EvaluationReport, description: RunDescription) -> None:
    """Write all files of a run folder but run.json and the figures."""
    dataset, truth = report.ranked.dataset, report.sequences[0].truth
    common = {
        "candidates": _num_candidates(report),
        "queries": report.num_queries,
        "dataset": dataset.name,
        "data_fingerprint": fingerprints(description.contents),
        "versions": versions(),
    }
    results = common | {
        **description.stages,
        "database": len(dataset.database),
        "incomplete": list(published_differences(dataset)),
        "ground_truth": ground_truth(report, description),
        "reading": readings(description.contents),
        "seconds": report.ranked.seconds,
    }
    lines, rows = [], report.rows()
    for row in rows:
        name = row["system"]
        scorers = report.ranked.system.final_scores[name].scorers
        about = {"scorer": " + ".join(scorers) or "none", "parameters": description.parameters[name]}
        recall_at = {str(k): round(recall, 6) for k, recall in row["recall_at"].items()}
        lines.append(row | {"recall_at": recall_at} | about | results)
    write_json(folder / "results.json", lines)
    write_rankings(folder, report)
    _write_changes(folder, report)
    _write_skipped(folder, report)
    if report.histogram is not None:
        _write_shifts(folder, report, report.histogram)
    if report.headline in report.probabilities:
        _write_top_predictions(folder, report)
    if truth is None:
        return
    write_table(folder, recall_table(rows), heading(report, description))
    write_gains(folder, report)
    _write_confidence(folder, report)
    provenance = common | {  # of confidences, which are fitted on these data
        "absent_queries": report.calibration[report.headline].num_absent,
        "correct_within": [middle(report.thresholds), truth.unit],
        "ground_truth": description.truth,
        "settings": description.settings,
        "command": description.command,
    }
    calibration = report.calibration.items()
    fits = {name: data.fit() for name, data in calibration if np.isfinite(data.present).all(axis=1).any()}
    write_confidences(folder / "confidence.json", fits, provenance)


def _names(report: EvaluationReport, rows: np.ndarray) -> Any:
    """Names of database images, "" for row -1."""
    return np.array([*report.ranked.dataset.database.names, ""], object)[rows]


def _cell(correct: np.ndarray | None, *place: Any) -> int | str:
    """1 or 0, or empty where it is unknown what is correct."""
    return "" if correct is None else int(correct[place])


def write_rankings(folder: Path, report: EvaluationReport) -> None:
    """Write `predictions/` and `failures/` of every system, those of the headline's into the folder itself.

    Only there, queries of low confidence have the prediction `NO_PLACE`.
    """
    database, files = report.ranked.dataset.database.names, file_names([*report.ranked.systems])
    refused = report.by_sequence(report.refusals(report.headline))
    for place, sequence in enumerate(report.sequences):
        target, names = report.folder(folder, place), (sequence.images.names, database)
        for name, parts in report.ranked.systems.items():
            ranked, correct = parts[place], report.is_correct(name, place)
            write_predictions(target / "predictions" / f"{files[name]}.csv", *names, ranked, correct)
            write_failures(target / "failures" / f"{files[name]}.csv", *names, ranked, correct)
            if name == report.headline:
                write_failures(target / "failures.csv", *names, ranked, correct)
                write_predictions(target / "predictions.csv", *names, ranked, correct, refused[place])


def write_predictions(
    path: Path,
    queries: Sequence[str],
    database: Sequence[str],
    ranked: Ranked,
    correct: Bool[np.ndarray, "queries candidates"] | None,
    refused: Bool[np.ndarray, " queries"] | None = None,
) -> None:
    """Write a CSV line per query and candidate, best first: `query,rank,database,score,correct,refused`.

    `correct` is 1 or 0, or empty where it is unknown. A query that is refused has one line, `NO_PLACE`, with score and
    `correct` of its first candidate, and its name in `refused`.
    """

    def lines() -> Iterator[list[Any]]:
        for (query, rank), row in np.ndenumerate(ranked.rows):
            is_refused = refused is not None and refused[query]
            candidate, score = (database[row], format_number(ranked.scores[query, rank])) if row >= 0 else ("", "")
            names = (NO_PLACE, candidate) if is_refused else (candidate, "")
            if rank == 0 if is_refused else row >= 0:
                yield [queries[query], rank + 1, names[0], score, _cell(correct, query, rank), names[1]]

    write_csv(path, ("query", "rank", "database", "score", "correct", "refused"), lines())


def write_failures(
    path: Path,
    queries: Sequence[str],
    database: Sequence[str],
    ranked: Ranked,
    correct: Bool[np.ndarray, "queries candidates"] | None,
) -> None:
    """Write `query,prediction,rank,correct_image,score,margin` of the queries whose top prediction is incorrect.

    `rank`, `correct_image` and `score` are of the first correct candidate, empty where there is none; `margin` is how
    much higher the first prediction scores, refused or not. Nothing is written without ground truth.
    """
    if correct is None:
        return
    lines = []
    for query in map(int, np.flatnonzero(~correct[:, 0])):
        names = [database[row] if row >= 0 else "" for row in ranked.rows[query]]
        rank, scores = int(np.argmax(correct[query])), ranked.scores[query]
        with np.errstate(invalid="ignore"):  # of two infinite scores
            numbers = [format_number(value) for value in (scores[rank], scores[0] - scores[rank])]
        first_correct = [rank + 1, names[rank], *numbers] if correct[query].any() else [""] * 4
        lines.append([queries[query], names[0], *first_correct])
    write_csv(path, ("query", "prediction", "rank", "correct_image", "score", "margin"), lines)


def _write_changes(folder: Path, report: EvaluationReport) -> None:
    """Write `changes.csv` with the queries whose first prediction a sequence changes, if the system has sequences."""
    scores = report.ranked.system.final_scores.values()
    filtered, lines = [score for score in scores if isinstance(score.step, DriveFilter)], []
    for score, (place, sequence) in itertools.product(filtered, enumerate(report.sequences)):
        systems = score.base, score.name
        rows = np.stack([report.ranked.systems[str(name)][place].rows[:, 0] for name in systems])
        correct, images = [report.is_correct(str(name), place) for name in systems], _names(report, rows)
        for query in np.flatnonzero(rows[0] != rows[1]):
            before, after = ([images[turn, query], _cell(correct[turn], query, 0)] for turn in (0, 1))
            lines.append([score.name, sequence.name, sequence.images.names[query], *before, *after])
    if filtered:
        header = ["system", "sequence", "query", "before", "correct_before", "after", "correct_after"]
        write_csv(folder / "changes.csv", header, lines)


def _write_skipped(folder: Path, report: EvaluationReport) -> None:
    """Write `skipped.csv` with images that could not be used and the reasons, if there are any."""
    names, matched = report.ranked.dataset.database.names, report.ranked.matched
    bad_rows = {bad for sequence in matched for bad in sequence.bad_database.items()}
    lines = sorted(("database", names[row], reason) for row, reason in bad_rows)
    for part in matched:
        queries = part.sequence.images.names
        lines += [("queries", queries[row], reason) for row, reason in part.bad_queries.items()]
    if lines:
        write_csv(folder / "skipped.csv", ["folder", "image", "reason"], lines)


def _write_shifts(folder: Path, report: EvaluationReport, scorer: HistogramOfShifts) -> None:
    """Write `shifts.csv` of every sequence: shifts of the headline's first predictions, candidate minus query, px.

    A line has the refined dominant shift of the query's middle, and its 95 % interval; empty if no match votes. Their
    px are those of the resized images, whose width and height follow. Queries that are refused have no line, features
    of several scales no file.
    """
    refused = report.by_sequence(report.refusals(report.headline))
    for place, ranked in enumerate(report.ranked.systems[report.headline]):
        matched = report.ranked.matched[place]
        if isinstance(matched.by_scale, Scales):
            continue
        predictions = ranked.rows[:, 0]
        queries = np.flatnonzero((predictions >= 0) & ~refused[place])
        places = np.argmax(matched.candidates.indices[queries] == predictions[queries, None], axis=1)
        shifts, intervals, sizes = dominant_shifts(scorer, matched.by_scale, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), sizes], axis=1)
        images, lines = _names(report, predictions), []
        for query, row in zip(queries, numbers, strict=True):
            lines.append([matched.sequence.images.names[query], images[query], *map(format_number, row)])
        write_csv(report.folder(folder, place) / "shifts.csv", ["query", "prediction", *SHIFTS], lines)


def _write_top_predictions(folder: Path, report: EvaluationReport) -> None:
    """Write `top_predictions.csv` of every sequence.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE` for a
    `reason`; `refused` is then its name, and `outcome` is "refused". `absent_confidence` is the confidence of the query
    without the images of its place. `in_database` is 1 where the database shows the query's place; elsewhere `NO_PLACE`
    is correct.
    """
    header = ["query", "prediction", "refused", "score", "confidence", "absent_confidence", "correct", "outcome"]
    header += ["reason", "in_database"]
    name, outcomes = report.headline, {"": "", 0: "incorrect", 1: "correct"}
    values = map(report.by_sequence, (report.reasons(name), *report.both_probabilities[name]))
    for place, (ranked, *parts) in enumerate(zip(report.ranked.systems[name], *values, strict=True)):
        is_correct, positives = report.is_correct(name, place), report.positives[place]
        in_database = None if positives is None else positives.counts > 0
        lines, images = [], _names(report, ranked.rows[:, 0])
        for query, (image, reason, *both) in enumerate(zip(report.sequences[place].images.names, *parts, strict=True)):
            predictions = [NO_PLACE, images[query]] if reason else [images[query], ""]
            numbers = [format_number(ranked.scores[query, 0])]
            numbers += ["" if np.isnan(p) else repr(float(p)) for p in both]  # rounding may move them to another bin
            correct = _cell(is_correct, query, 0)
            verdict = [correct, "refused" if reason else outcomes[correct], reason or "", _cell(in_database, query)]
            lines.append([image, *predictions, *numbers, *verdict])
        write_csv(report.folder(folder, place) / "top_predictions.csv", header, lines)


def write_gains(folder: Path, report: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, and `differences.csv`; with ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need.
    """
    systems, places, truth = [*report.ranked.systems], np.arange(report.num_queries), report.sequences[0].truth
    if truth is not None and (len(report.sequences) > 1 or truth.unit == "m"):  # else in the order of the queries
        known = [positives for positives in report.positives if positives is not None]
        places = places_along_path(stack_positives(known), truth.unit)
    header = ["query", "place", *(column for name in systems for column in (name, f"{name} rank"))]
    for part, sequence in enumerate(report.sequences):
        columns = [sequence.images.names, report.by_sequence(places)[part].tolist()]
        for name in systems:
            correct = np.asarray(report.is_correct(name, part), bool)
            ranks = np.where(correct.any(axis=1), np.argmax(correct, axis=1) + 1, 0)
            columns += [correct[:, 0].astype(int).tolist(), [rank or "" for rank in ranks.tolist()]]
        write_csv(report.folder(folder, part) / "gains.csv", header, zip(*columns, strict=True))
    path, lines = np.argsort(places, kind="stable"), []
    hits = {name: report.hits(name)[path] for name in systems}
    for first, second in itertools.combinations(systems, 2):
        lines.append([first, second, *difference_cells(hits[first], hits[second])])
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "design_effect", "path_p"]
    write_csv(folder / "differences.csv", header, lines)


def difference_cells(hits: Bool[np.ndarray, " queries"], others: Bool[np.ndarray, " queries"]) -> list[str]:
    """Tests of hits of two systems along a path: queries that only one of them predicts correctly, McNemar's p,
    design effect and p along the path.
    """
    only_first, only_second, p_value = mcnemar(hits, others)
    return [str(only_first), str(only_second), *map(format_number, (p_value, *path_test(hits, others)))]


def _write_confidence(folder: Path, report: EvaluationReport) -> None:
    """Write tables and curves of confidences, with ground truth."""
    table, recalls = confidence_table(report), recalls_by_share(report)
    write_csv(folder / "confidence.csv", table.header, table.rows)
    shares = zip(SHARES, *recalls.values(), strict=True) if RETRIEVAL in report.probabilities else ()
    lines = [[f"{share:.2f}", *(f"{100 * recall:.1f}" for recall in row)] for share, *row in shares]
    names = [name for name in report.ranked.systems if name != RETRIEVAL]
    write_csv(folder / "rerank_share.csv", ["re-ranked", *names], lines)
    points = []
    for name in report.ranked.systems:
        for by, curve in report.curves(name).items():
            points += [[name, by, *map(format_number, point)] for point in zip(*curve, strict=True)]
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
