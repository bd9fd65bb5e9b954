"""Files of the run folder of an evaluation: of `mfvpr evaluate`, and of `save` of a result in Python."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from mfvpr.datasets.contents import Contents, fingerprints
from mfvpr.datasets.positives import stack_positives
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.confidence import write_confidences
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.protocol import places_along_path
from mfvpr.evaluation.rankings import Fusion, Ranked
from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.evaluation.statistics import mcnemar, path_test
from mfvpr.report.evaluations import NO_PLACE, EvaluationReport, confidence_table, recall_table
from mfvpr.report.runs import file_names, write_about, write_json, write_table, writing
from mfvpr.report.tables import format_number, write_csv
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.fingerprints import versions

SHIFTS = ("shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "width", "height")  # px, of shifts.csv


@dataclass(frozen=True)
class RunDescription:
    """Settings of an evaluation, as JSON values for its run folder.

    Attributes:
        truth: kind, files, unit and thresholds of the ground truth; `truth_words` say the same in headings.
        contents: of the image files, by side.
        settings: that scores depend on, "retrieval", "features", "matching", "scorer" and maybe "fusion" among them.
    """

    truth: Mapping[str, Any]
    truth_words: str
    contents: Mapping[str, Contents]
    settings: Mapping[str, Any]
    command: str | None = None


def _parameters(report: EvaluationReport, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Parameters by final score: of its scorers, or of the fusion or the sequence that makes it of others."""
    scorers, by_name = settings["scorer"], dict[str, dict[str, Any]]()
    for score in report.ranked.system.final_scores.values():
        values = by_name[score.base] if score.base else {**scorers.get(score.name, {})}
        if isinstance(score.step, Fusion) and len(score.scorers) > 1:
            values = {name: scorers[name] for name in score.scorers}
        if isinstance(score.step, Fusion) and "fusion" in settings:
            values = values | settings["fusion"]
        elif score.step is not None:
            values = values | asdict(score.step)
        by_name[score.name] = values
    return by_name


def heading(report: EvaluationReport, description: RunDescription) -> str:
    """Data set, numbers of images, retrieval, features and ground truth in one line."""
    dataset, settings = report.ranked.dataset, description.settings
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {report.num_queries} queries{several}, {len(dataset.database)} database images, "
        f"{_num_candidates(report)} candidates ({settings['retrieval']['name']}), {matched_content(settings)}; "
        f"{description.truth_words}"
    )


def matched_content(settings: Mapping[str, Any]) -> str:
    """Words for the content that the matches come from: features, images, or files."""
    matching = settings["matching"]
    if matching.get("name") in ("import", "MatchFiles"):
        return "imported matches"
    is_of_images = matching.get("inputs") == "images"
    return f"matches of {matching['name']}" if is_of_images else f"{settings['features']['name']} features"


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
    pipeline, known, words = system.pipeline, {"kind": "none"}, "no ground truth: rankings only"
    if truth is not None:
        known = {"kind": type(truth).__name__, "unit": truth.unit, "thresholds": report.thresholds}
        words = f"recall in %, ground truth: {known['kind']}"
    several = len(dataset.sequences) > 1
    queries = {f"query {each.name}" if several else "query": each.images for each in dataset.sequences}
    folders = {"database": dataset.database, **queries}
    settings = {
        "dataset": {"name": dataset.name} | {side: str(images.root) for side, images in folders.items()},
        "retrieval": recipe(pipeline.retriever),
        "features": recipe(pipeline.extractor),
        "matching": recipe(pipeline.matcher),
        "candidates": pipeline.candidates,
        "scorer": {name: recipe(scorer) for name, scorer in system.scorers.items()},
        "ties": system.ties,
        "final": system.headline,
    }
    contents = {side: cache.recipes.contents(images) for side, images in folders.items()}
    description = RunDescription(known, words, contents, settings)
    with writing(folder) as new:
        write_run_folder(new, report, description)
        write_about(new, settings, ground_truth(report, description), None)


def write_run_folder(folder: Path, report: EvaluationReport, description: RunDescription) -> None:
    """Write all files of a run folder but run.json and the figures."""
    dataset, truth, rows = report.ranked.dataset, report.sequences[0].truth, report.rows()
    common = {
        "candidates": _num_candidates(report),
        "queries": report.num_queries,
        "dataset": dataset.name,
        "data_fingerprint": fingerprints(description.contents),
        "versions": versions(),
    }
    results = common | {
        **{name: description.settings[name] for name in ("retrieval", "features", "matching")},
        "database": len(dataset.database),
        "incomplete": list(published_differences(dataset)),
        "description": heading(report, description),
        "ground_truth": ground_truth(report, description),
        "seconds": report.ranked.seconds,
    }
    lines, parameters = [], _parameters(report, description.settings)
    for row in rows:
        name = row["system"]
        scorers = " + ".join(report.ranked.system.final_scores[name].scorers)
        about = {"scorer": scorers or "none", "parameters": parameters[name]}
        recall_at = {str(k): round(recall, 6) for k, recall in row["recall_at"].items()}
        lines.append(row | {"recall_at": recall_at} | about | results)
    write_json(folder / "results.json", lines)
    for place in range(len(report.sequences)):
        _write_sequence(report.folder(folder, place), report, place)
    _write_changes(folder, report)
    _write_skipped(folder, report)
    if truth is None:
        return
    write_table(folder, recall_table(rows), heading(report, description))
    write_gains(folder, report)
    table, points = confidence_table(report), []
    write_csv(folder / "confidence.csv", table.header, table.rows)
    for name in report.ranked.systems:
        for by, curve in report.curves(name).items():
            points += [[name, by, *map(format_number, point)] for point in zip(*curve, strict=True)]
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    provenance = common | {  # of confidences, which are fitted on these data
        "absent_queries": report.calibration[report.headline].num_absent,
        "correct_within": [report.threshold, truth.unit],
        "ground_truth": description.truth,
        "settings": description.settings,
        "command": description.command,
    }
    calibration = report.calibration.items()
    fits = {name: data.fit() for name, data in calibration if np.isfinite(data.present).all(axis=1).any()}
    write_confidences(folder / "confidence.json", fits, provenance)


def _names(database: Sequence[str], rows: np.ndarray) -> Any:
    """Names of database images, "" for row -1."""
    return np.array([*database, ""], object)[rows]


def _cells(correct: np.ndarray | None, number: int) -> list[int | str]:
    """1 or 0 for so many lines, or empty where it is unknown what is correct."""
    return [""] * number if correct is None else correct.astype(int).tolist()


def _write_columns(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    write_csv(path, [*columns], zip(*columns.values(), strict=True))


def _write_sequence(folder: Path, report: EvaluationReport, place: int) -> None:
    """Write rankings of a sequence by every system, and shifts and confidences of the one that decides."""
    names, database = report.sequences[place].images.names, report.ranked.dataset.database.names
    headline, files = report.headline, file_names([*report.ranked.systems])
    refused = report.by_sequence(report.refusals(headline))[place]
    for name, parts in report.ranked.systems.items():
        ranking = names, database, parts[place], report.is_correct(name, place)
        write_predictions(folder / "predictions" / f"{files[name]}.csv", *ranking)
        if name == headline:
            write_predictions(folder / "predictions.csv", *ranking, refused)
    matched, predictions = report.ranked.matched[place], report.ranked.systems[headline][place].rows[:, 0]
    if report.histogram is not None and not isinstance(matched.by_scale, Scales):
        queries = np.flatnonzero((predictions >= 0) & ~refused)
        places = np.argmax(matched.candidates.indices[queries] == predictions[queries, None], axis=1)
        shifts, intervals, sizes = dominant_shifts(report.histogram, matched.by_scale, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), sizes], axis=1)
        columns = {"query": [names[query] for query in queries], "prediction": _names(database, predictions[queries])}
        columns |= {name: [*map(format_number, column)] for name, column in zip(SHIFTS, numbers.T, strict=True)}
        _write_columns(folder / "shifts.csv", columns)
    if headline in report.probabilities:
        _write_top_predictions(folder, report, place)


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
    is_refused = np.zeros(len(queries), bool) if refused is None else refused
    is_shown = (ranked.rows >= 0) & ~is_refused[:, None]
    is_shown[:, 0] |= is_refused
    query, rank = np.nonzero(is_shown)
    images, is_refused = _names(database, ranked.rows[query, rank]), is_refused[query]
    columns = {
        "query": [queries[row] for row in query.tolist()],
        "rank": (rank + 1).tolist(),
        "database": np.where(is_refused, NO_PLACE, images),
        "score": [*map(format_number, np.where(ranked.rows >= 0, ranked.scores, np.nan)[query, rank])],
        "correct": _cells(None if correct is None else correct[query, rank], len(query)),
        "refused": np.where(is_refused, images, ""),
    }
    _write_columns(path, columns)


def _write_top_predictions(folder: Path, report: EvaluationReport, place: int) -> None:
    """Write `top_predictions.csv` of a sequence.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE` for a
    `reason`. `absent_confidence` is that without the images of the query's place, which `in_database` shows or not.
    """
    name, names = report.headline, report.sequences[place].images.names
    ranked, positives = report.ranked.systems[name][place], report.positives[place]
    database, is_correct = report.ranked.dataset.database.names, report.is_correct(name, place)
    correct = None if is_correct is None else is_correct[:, 0]
    values = (report.reasons(name), *report.both_probabilities[name])
    reasons, *both = (report.by_sequence(value)[place] for value in values)
    is_refused, images = np.array([reason is not None for reason in reasons], bool), _names(database, ranked.rows[:, 0])
    outcomes = np.full(len(names), "") if correct is None else np.where(correct, "correct", "incorrect")
    # Rounding may move a confidence to another bin.
    confidences = [["" if np.isnan(p) else repr(float(p)) for p in column] for column in both]
    columns = {
        "query": names,
        "prediction": np.where(is_refused, NO_PLACE, images),
        "refused": np.where(is_refused, images, ""),
        "score": [*map(format_number, ranked.scores[:, 0])],
        "confidence": confidences[0],
        "absent_confidence": confidences[1],
        "correct": _cells(correct, len(names)),
        "outcome": np.where(is_refused, "refused", outcomes),
        "reason": [reason or "" for reason in reasons],
        "in_database": _cells(None if positives is None else positives.counts > 0, len(names)),
    }
    _write_columns(folder / "top_predictions.csv", columns)


def _write_changes(folder: Path, report: EvaluationReport) -> None:
    """Write `changes.csv` with the queries whose first prediction a sequence changes, if the system has sequences."""
    scores, lines = report.ranked.system.final_scores.values(), []
    database = report.ranked.dataset.database.names
    filtered = [score for score in scores if isinstance(score.step, DriveFilter)]
    for score, (place, sequence) in itertools.product(filtered, enumerate(report.sequences)):
        before, after = (report.ranked.systems[name][place].rows[:, 0] for name in (score.base, score.name))
        columns: list[Any] = [sequence.images.names]
        for name, rows in ((score.base, before), (score.name, after)):
            correct = report.is_correct(name, place)
            columns += [_names(database, rows), _cells(None if correct is None else correct[:, 0], len(rows))]
        changed = itertools.compress(zip(*columns, strict=True), before != after)
        lines += [[score.name, sequence.name, *line] for line in changed]
    if filtered:
        header = ["system", "sequence", "query", "before", "correct_before", "after", "correct_after"]
        write_csv(folder / "changes.csv", header, lines)


def _write_skipped(folder: Path, report: EvaluationReport) -> None:
    """Write `skipped.csv` with images that could not be used and the reasons, if there are any."""
    names, matched = report.ranked.dataset.database.names, report.ranked.matched
    lines = sorted({("database", names[row], reason) for part in matched for row, reason in part.bad_database.items()})
    for part in matched:
        lines += [("queries", part.sequence.images.names[row], reason) for row, reason in part.bad_queries.items()]
    if lines:
        write_csv(folder / "skipped.csv", ["folder", "image", "reason"], lines)


def write_gains(folder: Path, report: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, and `differences.csv`; with ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need.
    """
    systems, places, truth = [*report.ranked.systems], np.arange(report.num_queries), report.sequences[0].truth
    if truth is not None and (len(report.sequences) > 1 or truth.unit == "m"):  # else in the order of the queries
        known = [positives for positives in report.positives if positives is not None]
        places = places_along_path(stack_positives(known), truth.unit)
    for part, sequence in enumerate(report.sequences):
        columns = {"query": sequence.images.names, "place": report.by_sequence(places)[part].tolist()}
        for name in systems:
            correct = np.asarray(report.is_correct(name, part), bool)
            ranks = np.where(correct.any(axis=1), np.argmax(correct, axis=1) + 1, 0)
            columns[name] = correct[:, 0].astype(int).tolist()
            columns[f"{name} rank"] = [rank or "" for rank in ranks.tolist()]
        _write_columns(report.folder(folder, part) / "gains.csv", columns)
    path, lines = np.argsort(places, kind="stable"), []
    hits = {name: report.hits(name)[path] for name in systems}
    for first, second in itertools.combinations(systems, 2):
        test, path_p = mcnemar(hits[first], hits[second]), path_test(hits[first], hits[second])
        numbers = map(format_number, (test.p_value, *path_p))
        lines.append([first, second, test.only_first, test.only_second, *numbers])
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "design_effect", "path_p"]
    write_csv(folder / "differences.csv", header, lines)
