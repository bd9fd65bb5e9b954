"""Files of the run folder of an evaluation, and its predictions as files of other programs."""

import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from mfvpr.core.types import Shortlist
from mfvpr.datasets.contents import Contents, fingerprints
from mfvpr.datasets.datasets import ImageFolder
from mfvpr.datasets.positives import Positives
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.confidence import write_confidences
from mfvpr.evaluation.dataset_ranking import num_candidates
from mfvpr.evaluation.protocol import places_along_path
from mfvpr.evaluation.rankings import Fusion, Ranked
from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.evaluation.statistics import mcnemar, path_test
from mfvpr.io.containers import reading, shorten
from mfvpr.io.shortlists import write_shortlist
from mfvpr.io.trajectories import SECOND, read_poses, write_trajectory
from mfvpr.report.evaluations import NO_PLACE, EvaluationReport, confidence_table, recall_table
from mfvpr.report.runs import file_names, read_csv, write_about, write_csv, write_json, write_table, writing
from mfvpr.retrieval.retriever import standardizations
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_replaceable
from mfvpr.utils.fingerprints import versions

CandidateLayout = Literal["preds", "hloc", "kapture"]
_NUMBERS = ("confidence", "shift_x", "shift_y", "low_x", "low_y", "high_x", "high_y", "image_width")
_CELLS = (*_NUMBERS, "reason")
SHIFT_COLUMNS = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id", "place", *_CELLS, "image")
_FRAME = "camera"  # header.frame_id
SHIFTS = ("shift_x", "shift_y", "low_x", "high_x", "low_y", "high_y", "width", "height")  # px, of shifts.csv


@dataclass(frozen=True)
class RunDescription:
    """Settings of an evaluation, as JSON values for its run folder."""

    truth: Mapping[str, Any]  # kind, files, unit and thresholds of the ground truth
    truth_words: str  # the same in headings
    remark: str = field(default="", kw_only=True)  # behind the heading
    contents: Mapping[str, Contents]  # of the image files, by side
    settings: Mapping[str, Any]  # "retrieval", "features", "matching", "scorer", and others that scores depend on
    command: str | None = None


def _parameters(report: EvaluationReport, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Scorers of each final score, and their parameters, with those of its fusion or sequence."""
    scorers, about = settings["scorer"], dict[str, dict[str, Any]]()
    for score in report.ranked.system.final_scores.values():
        values = about[score.base]["parameters"] if score.base else {**scorers.get(score.name, {})}
        if isinstance(score.step, Fusion) and len(score.scorers) > 1:
            values = {name: scorers[name] for name in score.scorers}
        if isinstance(score.step, Fusion) and "fusion" in settings:
            values = values | settings["fusion"]
        elif score.step is not None:
            values = values | asdict(score.step)
        about[score.name] = {"scorer": " + ".join(score.scorers) or "none", "parameters": values}
    return about


def heading(report: EvaluationReport, description: RunDescription) -> str:
    """Data set, numbers of images, retrieval, features and ground truth in one line."""
    dataset, settings = report.ranked.dataset, description.settings
    candidates = num_candidates(report.ranked.system.pipeline.candidates, dataset.database)
    names = settings["retrieval"].get("name") or " and ".join(settings["retrieval"])
    retrieval = ", standardized by ".join([names, *standardizations_of(report)])
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {len(report.queries)} queries{several}, {len(dataset.database)} database images, "
        f"{candidates} candidates ({retrieval}), {matched_content(settings)}; "
        f"{description.truth_words}; predictions by {report.headline}{description.remark}"
    )


def standardizations_of(report: EvaluationReport) -> list[str]:
    """The rules by which the retrieval standardized descriptors."""
    return sorted(standardizations(report.ranked.system.pipeline.retriever, report.sequences))


def matched_content(settings: Mapping[str, Any]) -> str:
    """Words for the content that the matches come from: features, images, or files."""
    matching = settings["matching"]
    if matching.get("name") in ("import", "MatchFiles"):
        return "imported matches"
    is_of_images = matching.get("inputs") == "images"
    return f"matches of {matching['name']}" if is_of_images else f"{settings['features']['name']} features"


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

    dataset, system, truth = report.ranked.dataset, report.ranked.system, report.truth
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
    dataset, truth, rows = report.ranked.dataset, report.truth, report.rows()
    common = {
        "candidates": num_candidates(report.ranked.system.pipeline.candidates, dataset.database),
        "queries": len(report.queries),
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
        recall_at = {str(k): round(recall, 6) for k, recall in row["recall_at"].items()}
        lines.append(row | {"recall_at": recall_at} | parameters[row["system"]] | results)
    write_json(folder / "results.json", lines)
    _write_rankings(folder, report)
    _write_shifts(folder, report)
    if report.headline in report.probabilities:
        _write_top_predictions(folder, report)
    skipped, matched = list[tuple[str, str, str]](), report.ranked.matched
    for row, reason in sorted({pair for part in matched for pair in part.bad_database.items()}):
        skipped.append(("database", dataset.database.names[row], reason))
    for part in matched:
        skipped += [("queries", part.sequence.images.names[row], reason) for row, reason in part.bad_queries.items()]
    if skipped:  # images that could not be used
        write_csv(folder / "skipped.csv", ["folder", "image", "reason"], skipped)
    if truth is None:
        return
    write_table(folder, recall_table(rows), heading(report, description))
    write_gains(folder, report)
    table, points = confidence_table(report), []
    write_csv(folder / "confidence.csv", table.header, table.rows)
    for name in report.ranked.systems:
        for by, curve in report.curves(name).items():
            points += [[name, by, *point] for point in zip(*curve, strict=True)]
    write_csv(folder / "precision_recall.csv", ["system", "by", "threshold", "precision", "recall"], points)
    provenance = common | {  # of confidences, which are fitted on these data
        "absent_queries": report.calibration[report.headline].num_absent,
        "correct_within": [report.threshold, truth.unit],
        "ground_truth": description.truth,
        "settings": description.settings,
        "command": description.command,
    }
    calibration = report.calibration.items()
    rules = " and ".join(standardizations_of(report)) or None
    fits = {
        name: replace(data.fit(), standardize=rules)
        for name, data in calibration
        if np.isfinite(data.present).all(axis=1).any()
    }
    write_confidences(folder / "confidence.json", fits, provenance)


def _names(database: Sequence[str], rows: np.ndarray) -> np.ndarray:
    """Names of database images, "" for row -1."""
    return np.array([*database, ""], object)[rows]


def _cells(correct: np.ndarray | None, number: int) -> np.ndarray:
    """1 or 0 for so many lines, or empty where it is unknown what is correct."""
    return np.full(number, "") if correct is None else correct.astype(int)


def _write_queries(folder: Path, report: EvaluationReport, name: str, columns: Mapping[str, Any]) -> None:
    """Write a table for each sequence, from columns of all queries."""
    columns = {"query": [name for _, name in report.queries], **columns}
    for place, part in enumerate(report.parts):
        lines = zip(*(column[part] for column in columns.values()), strict=True)
        write_csv(report.folder(folder, place) / name, [*columns], lines)


def _write_rankings(folder: Path, report: EvaluationReport) -> None:
    """Write the rankings of each sequence by every system, and with refusals by the one that decides."""
    database, files, refused = report.ranked.dataset.database.names, file_names([*report.rankings]), report.refusals
    for place, part in enumerate(report.parts):
        target, queries = report.folder(folder, place), report.sequences[place].images.names
        for name, rankings in report.ranked.systems.items():
            ranking = queries, database, rankings[place], report.correct[name][part] if report.thresholds else None
            write_predictions(target / "predictions" / f"{files[name]}.csv", *ranking)
            if name == report.headline:
                write_predictions(target / "predictions.csv", *ranking, refused(name)[part])


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
    columns = [
        [queries[row] for row in query.tolist()],
        (rank + 1).tolist(),
        np.where(is_refused, NO_PLACE, images),
        np.where(ranked.rows >= 0, ranked.scores, np.nan)[query, rank],
        _cells(None if correct is None else correct[query, rank], len(query)),
        np.where(is_refused, images, ""),
    ]
    write_csv(path, ["query", "rank", "database", "score", "correct", "refused"], zip(*columns, strict=True))


def _write_shifts(folder: Path, report: EvaluationReport) -> None:
    """Write `shifts.csv` of the predictions that are not refused, if a histogram of features of one scale decides."""
    rows, database = report.rankings[report.headline].rows[:, 0], report.ranked.dataset.database.names
    is_shown = (rows >= 0) & ~report.refusals(report.headline)
    for place, part in enumerate(report.parts):
        matched, queries = report.ranked.matched[place], np.flatnonzero(is_shown[part])
        if report.histogram is None or isinstance(matched.by_scale, Scales):
            continue
        predictions, names = rows[part][queries], report.sequences[place].images.names
        ranks = np.argmax(matched.candidates.indices[queries] == predictions[:, None], axis=1)
        shifts, intervals, sizes = dominant_shifts(report.histogram, matched.by_scale, queries, ranks)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), sizes], axis=1)
        pairs = zip(queries.tolist(), _names(database, predictions), numbers, strict=True)
        lines = ([names[query], prediction, *line] for query, prediction, line in pairs)
        write_csv(report.folder(folder, place) / "shifts.csv", ["query", "prediction", *SHIFTS], lines)


def _write_top_predictions(folder: Path, report: EvaluationReport) -> None:
    """Write `top_predictions.csv`.

    `score`, `confidence` and `correct` are of the first candidate, also where the prediction is `NO_PLACE` for a
    `reason`. `absent_confidence` is that without the images of the query's place, which `in_database` shows or not.
    """
    name, count, positives = report.headline, len(report.queries), report.positives
    ranked, reasons = report.rankings[name], report.reasons(name)
    images = _names(report.ranked.dataset.database.names, ranked.rows[:, 0])
    is_refused = np.array([reason is not None for reason in reasons])
    correct = None if positives is None else report.hits(name)
    outcomes = np.full(count, "") if correct is None else np.where(correct, "correct", "incorrect")
    # Rounding may move a confidence to another bin.
    both = [["" if np.isnan(p) else repr(p) for p in values.tolist()] for values in report.probabilities[name]]
    columns = {
        "prediction": np.where(is_refused, NO_PLACE, images),
        "refused": np.where(is_refused, images, ""),
        "score": ranked.scores[:, 0],
        "confidence": both[0],
        "absent_confidence": both[1],
        "correct": _cells(correct, count),
        "outcome": np.where(is_refused, "refused", outcomes),
        "reason": [reason or "" for reason in reasons],
        "in_database": _cells(None if positives is None else positives.counts > 0, count),
    }
    _write_queries(folder, report, "top_predictions.csv", columns)


def write_gains(folder: Path, report: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, and `differences.csv`; with ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need.
    """
    places, truth, positives = np.arange(len(report.queries)), report.truth, report.positives
    if truth and positives and (len(report.sequences) > 1 or truth.unit == "m"):  # else in the order of the queries
        places = places_along_path(positives, truth.unit)
    columns: dict[str, Any] = {"place": places}
    for name, correct in report.correct.items():
        ranks = np.where(correct.any(axis=1), np.argmax(correct, axis=1) + 1, 0)
        columns |= {name: correct[:, 0].astype(int), f"{name} rank": [rank or "" for rank in ranks.tolist()]}
    _write_queries(folder, report, "gains.csv", columns)
    path, lines = np.argsort(places, kind="stable"), []
    hits = {name: report.hits(name)[path] for name in report.correct}
    for first, second in itertools.combinations(hits, 2):
        test, path_p = mcnemar(hits[first], hits[second]), path_test(hits[first], hits[second])
        lines.append([first, second, *test, *path_p])
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "design_effect", "path_p"]
    write_csv(folder / "differences.csv", header, lines)


# --- predictions for other programs ------------------------------------------------------------------------------


@dataclass(frozen=True)
class LocalizedImage:
    """A query with its prediction."""

    name: str
    place: Any = None  # any JSON value; None = no place
    candidates: Sequence[tuple[str, float]] = ()  # names of database images and scores, best first; none without place
    cells: Mapping[str, str] = field(default_factory=dict)  # of the table of shifts, by column


def write_candidates(
    path: Path | str,
    shortlist: Shortlist,
    queries: ImageFolder,
    database: ImageFolder,
    layout: CandidateLayout,
    positives: Positives | None = None,
    *,
    prefixes: tuple[str, str] = ("", ""),
) -> None:
    """Write candidates as `mfvpr.io.write_shortlist`; `preds` has full paths, and the correct images if known.

    Other layouts have `prefixes` before the names of queries and database images.
    """
    names = [[prefix + name for name in side.names] for side, prefix in zip((queries, database), prefixes, strict=True)]
    if layout == "preds":
        names = [[os.path.abspath(path) for path in side.paths] for side in (queries, database)]
    correct = None if positives is None else [positives.of(row).tolist() for row in range(len(queries))]
    write_shortlist(path, shortlist, *names, layout=layout, positives=correct)


def write_poses(
    path: Path | str,
    images: Sequence[LocalizedImage],
    poses: Path,
    database: Sequence[str],
    stamps: Sequence[int] | None,
) -> None:
    """Write the pose of each first candidate, as `mfvpr.io.write_trajectory`; `stamps` None = KITTI.

    `poses` is a file of the `database` images, as `mfvpr.io.read_poses` reads it.
    """
    by_name = dict(zip(database, read_poses(poses, database), strict=True))
    texts = []
    for image in images:
        name = image.candidates[0][0] if image.candidates else None
        if image.place is not None and name not in by_name:
            words = "localize with alternatives=1 or more, and name the folder of the database"
            raise InputError(f"{shorten(image.name)}: expected a database image with a pose, got {name}; {words}")
        texts.append(None if image.place is None or name is None else by_name[name])
    write_trajectory(path, texts, stamps)


def write_shift_table(path: Path, images: Sequence[LocalizedImage], stamps: Sequence[int]) -> None:
    """Write a CSV line per image with `SHIFT_COLUMNS`, in the order of the times `stamps` (ns), as ROS names them.

    The file must be new. Unknown numbers, and the place of an image without one, are empty cells.
    """
    require_replaceable(path)
    lines = []
    for row in sorted(range(len(images)), key=stamps.__getitem__):
        place, cells = images[row].place, [images[row].cells.get(name, "") for name in _CELLS]
        text = "" if place is None else place if isinstance(place, str) else json.dumps(place, ensure_ascii=False)
        lines.append([stamps[row] // SECOND, stamps[row] % SECOND, _FRAME, text, *cells, images[row].name])
    write_csv(path, SHIFT_COLUMNS, lines)


def shortlist_of(images: Sequence[LocalizedImage], database: Sequence[str]) -> Shortlist:
    """Candidates `[Q, C]` of localized images."""
    rows = {name: row for row, name in enumerate(database)}
    depth = max((len(image.candidates) for image in images), default=0)
    indices, scores = np.full((len(images), depth), -1, np.int32), np.zeros((len(images), depth), np.float32)
    for query, image in enumerate(images):
        for rank, (name, score) in enumerate(image.candidates):
            if name not in rows:
                raise InputError(f"{shorten(name)}: expected an image of the database; the data set has changed")
            indices[query, rank], scores[query, rank] = rows[name], score
    return Shortlist(indices=indices, scores=scores, mask=indices >= 0)


def read_lines(path: Path) -> list[LocalizedImage]:
    """Read the lines of `mfvpr localize`; an image that could not be read has no place, and its error as reason."""
    images = []
    with reading(path, mend="expected lines of mfvpr localize"):
        for line in filter(str.strip, path.read_text(encoding="utf-8").split("\n")):
            values = json.loads(line)
            if "error" in values:
                images.append(LocalizedImage(values["image"], cells={"reason": values["error"]}))
                continue
            low, high = values["shift_interval"] or [[None, None]] * 2
            numbers = [values["confidence"], *(values["shift"] or [None] * 2), *low, *high, values["image_width"]]
            cells = {name: str(number) for name, number in zip(_NUMBERS, numbers, strict=True) if number is not None}
            candidates = [(each["name"], each["score"]) for each in values["alternatives"]]
            if values["place"] is None:
                cells, candidates = cells | {"reason": values["reason"]}, []
            images.append(LocalizedImage(values["image"], values["place"], candidates, cells))
    return images


def read_run_images(folder: Path, queries: Sequence[str]) -> list[LocalizedImage]:
    """Localized images of a sequence of an evaluation, from the files in its folder; refused queries have no place."""
    candidates, cells = ({query: [] for query in queries}, {query: {} for query in queries})
    with reading(folder / "predictions.csv", mend="expected the folder of an evaluation, of this data set"):
        for row in read_csv(folder / "predictions.csv"):
            if row["database"] != NO_PLACE:
                candidates[row["query"]].append((row["database"], float(row["score"])))
        for path in (folder / "top_predictions.csv", folder / "shifts.csv"):
            for row in read_csv(path) if path.exists() else ():
                row["image_width"] = row.get("width", "")
                cells[row["query"]] |= {name: row[name] for name in _CELLS if row.get(name)}
    places = {query: names[0][0] if names else None for query, names in candidates.items()}
    return [LocalizedImage(query, places[query], candidates[query], cells[query]) for query in queries]
