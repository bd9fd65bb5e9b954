"""Files of the run folder of an evaluation: of `mfvpr evaluate`, and of `save` of a result in Python."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from mfvpr.core.histogram import HistogramOfShifts
from mfvpr.datasets.contents import Contents, fingerprints, readings
from mfvpr.datasets.ground_truth import middle
from mfvpr.datasets.positives import stack_positives
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.dataset_ranking import RankedDataset
from mfvpr.evaluation.drives import DriveFilter
from mfvpr.evaluation.fusion import FinalScore, Fusion
from mfvpr.evaluation.protocol import places_along_path
from mfvpr.evaluation.rankings import Ranked
from mfvpr.evaluation.sequence_matching import num_candidates
from mfvpr.evaluation.stages import Scales, dominant_shifts
from mfvpr.evaluation.statistics import McNemar, PathTest, mcnemar, path_test
from mfvpr.report.confidences import write_confidence
from mfvpr.report.evaluations import NO_PLACE, EvaluationReport, recall_table
from mfvpr.report.runs import file_names, write_about, write_json, write_table, writing
from mfvpr.report.tables import Table, format_number, write_csv
from mfvpr.storage.feature_cache import FeatureCache
from mfvpr.utils.files import write_text
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

    def skipped(number: int) -> str:
        return f" ({number} skipped)" if number else ""

    dataset, matched, stages = report.ranked.dataset, report.ranked.matched, description.stages
    bad_queries = sum(len(sequence.bad_queries) for sequence in matched)
    bad_database = len({row for sequence in matched for row in sequence.bad_database})
    matching = stages["matching"]
    check = f"cross_check={matching['cross_check']}" if "cross_check" in matching else matching["name"]
    check = "" if check in ("cross_check=mutual", "import", "MatchFiles") else f", {check}"
    several = f" in {len(dataset.sequences)} sequences" if len(dataset.sequences) > 1 else ""
    incomplete = " (incomplete)" if any(published_differences(dataset)) else ""
    return (
        f"{dataset.name}{incomplete}: {report.num_queries} queries{several}{skipped(bad_queries)}, "
        f"{len(dataset.database)} database images{skipped(bad_database)}, "
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
    rows = []
    for name, score in report.ranked.system.final_scores.items():
        system = {
            "system": name,
            "scorer": " + ".join(score.scorers) or "none",
            "decides": name == report.headline,
            "parameters": description.parameters[name],
        }
        rows += [system | recall | results for recall in report.rows(name)]
    write_json(folder / "results.json", rows)
    if report.thresholds:
        write_table(folder, recall_table(report), heading(report, description))
    write_rankings(folder, report)
    write_gains(folder, report)
    provenance = common | {  # of confidences, which are fitted on these data
        "absent_queries": report.calibration[report.headline].num_absent if truth else 0,
        "correct_within": [middle(report.thresholds), truth.unit] if truth else None,
        "ground_truth": description.truth,
        "settings": description.settings,
        "command": description.command,
    }
    write_confidence(folder, report, provenance)
    if report.histogram is not None:
        _write_shifts(folder, report, report.histogram)
    _write_changes(folder, report)
    _write_skipped(folder, report.ranked)


def _write_shifts(folder: Path, evaluation: EvaluationReport, scorer: HistogramOfShifts) -> None:
    """Write `shifts.csv` of every sequence: shifts of the headline's first predictions, candidate minus query, px.

    A line has the refined dominant shift of the query's middle, and its 95 % interval; empty if no match votes. Their
    px are those of the resized images, whose width and height follow. Queries that are refused have no line, features
    of several scales no file.
    """
    names = evaluation.ranked.dataset.database.names
    refused = evaluation.by_sequence(evaluation.refusals(evaluation.headline))
    for place, ranked in enumerate(evaluation.ranked.systems[evaluation.headline]):
        matched = evaluation.ranked.matched[place]
        if isinstance(matched.by_scale, Scales):
            continue
        predictions = ranked.rows[:, 0]
        queries = np.flatnonzero((predictions >= 0) & ~refused[place])
        places = np.argmax(matched.candidates.indices[queries] == predictions[queries, None], axis=1)
        shifts, intervals, sizes = dominant_shifts(scorer, matched.by_scale, queries, places)
        numbers = np.concatenate([shifts, intervals.transpose(0, 2, 1).reshape(-1, 4), sizes], axis=1)
        lines = []
        for query, row in zip(queries, numbers, strict=True):
            pair = matched.sequence.images.names[query], names[predictions[query]]
            lines.append([*pair, *map(format_number, row)])
        write_csv(evaluation.folder(folder, place) / "shifts.csv", ["query", "prediction", *SHIFTS], lines)


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


def _num_candidates(report: EvaluationReport) -> int:
    return num_candidates(report.ranked.system.pipeline.candidates, report.ranked.dataset.database)


def write_rankings(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `predictions/` and `failures/` of every system, those of the headline's into the folder itself.

    Only there, queries of low confidence have the prediction `NO_PLACE`.
    """
    database, files = evaluation.ranked.dataset.database.names, file_names([*evaluation.ranked.systems])
    refused = evaluation.by_sequence(evaluation.refusals(evaluation.headline))
    for place, sequence in enumerate(evaluation.sequences):
        target, names = evaluation.folder(folder, place), (sequence.images.names, database)
        for name, parts in evaluation.ranked.systems.items():
            ranked, correct = parts[place], evaluation.is_correct(name, place)
            write_predictions(target / "predictions" / f"{files[name]}.csv", *names, ranked, correct)
            write_failures(target / "failures" / f"{files[name]}.csv", *names, ranked, correct)
            if name == evaluation.headline:
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
                is_correct = "" if correct is None else int(correct[query, rank])
                yield [queries[query], rank + 1, names[0], score, is_correct, names[1]]

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


def _write_skipped(folder: Path, ranked: RankedDataset) -> None:
    """Write `skipped.csv` with images that could not be used and the reasons, if there are any."""
    names = ranked.dataset.database.names
    bad_rows = {bad for matched in ranked.matched for bad in matched.bad_database.items()}
    lines = sorted(("database", names[row], reason) for row, reason in bad_rows)
    for matched in ranked.matched:
        queries = matched.sequence.images.names
        lines += [("queries", queries[row], reason) for row, reason in matched.bad_queries.items()]
    if lines:
        write_csv(folder / "skipped.csv", ["folder", "image", "reason"], lines)


def _write_changes(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `changes.csv` with the queries whose first prediction a sequence changes, if the system has sequences.

    `correct_before` and `correct_after` are 1 or 0, or empty where it is unknown.
    """
    names, systems = evaluation.ranked.dataset.database.names, evaluation.ranked.systems
    scores = evaluation.ranked.system.final_scores.values()
    sequences = [(score.name, score.base) for score in scores if isinstance(score.step, DriveFilter)]
    lines = []
    for (name, base), (place, sequence) in itertools.product(sequences, enumerate(evaluation.sequences)):
        rows = [systems[system][place].rows[:, 0] for system in (base, name)]
        correct = [evaluation.is_correct(system, place) for system in (base, name)]
        for query in np.flatnonzero(rows[0] != rows[1]):
            cells = []
            for row, is_correct in zip(rows, correct, strict=True):
                cells.append(names[row[query]] if row[query] >= 0 else "")
                cells.append("" if is_correct is None else int(is_correct[query, 0]))
            lines.append([name, sequence.name, sequence.images.names[query], *cells])
    if sequences:
        header = ["system", "sequence", "query", "before", "correct_before", "after", "correct_after"]
        write_csv(folder / "changes.csv", header, lines)


class Difference(NamedTuple):
    """Tests of two systems on the first predictions of all queries of all sequences."""

    first: str
    second: str
    mcnemar: McNemar
    path: PathTest

    @property
    def cells(self) -> list[str]:
        """A line of `differences.csv`."""
        only_first, only_second, p_value = self.mcnemar
        return [self.first, self.second, str(only_first), str(only_second), *map(format_number, (p_value, *self.path))]


def differences(evaluation: EvaluationReport) -> list[Difference]:
    """Tests of every two systems, in their order, with ground truth."""
    path = np.argsort(_places(evaluation), kind="stable")
    hits = {name: evaluation.hits(name)[path] for name in evaluation.ranked.systems}
    tests = []
    for (first, first_hits), (second, second_hits) in itertools.combinations(hits.items(), 2):
        pair = first_hits, second_hits
        tests.append(Difference(first, second, mcnemar(*pair), path_test(*pair)))
    return tests


def _places(evaluation: EvaluationReport) -> np.ndarray:
    """`[Q]` places of all queries along the map; those of one sequence without positions are in their order."""
    truth = evaluation.sequences[0].truth
    if truth is None or (len(evaluation.sequences) == 1 and truth.unit != "m"):
        return np.arange(evaluation.num_queries)
    known = [positives for positives in evaluation.positives if positives is not None]
    return places_along_path(stack_positives(known), truth.unit)


def write_gains(folder: Path, evaluation: EvaluationReport) -> None:
    """Write `gains.csv` of every sequence, `differences.csv` and `differences.md`; nothing without ground truth.

    By query and system, `gains.csv` says whether the first prediction is correct, and the rank of the first correct
    one. Its `place` along the map says which queries are neighbors, which intervals and tests across runs need.
    """
    if not evaluation.thresholds:
        return
    systems, places = [*evaluation.ranked.systems], evaluation.by_sequence(_places(evaluation))
    header = ["query", "place", *(column for name in systems for column in (name, f"{name} rank"))]
    for part, sequence in enumerate(evaluation.sequences):
        columns = [sequence.images.names, places[part].tolist()]
        for name in systems:
            correct = np.asarray(evaluation.is_correct(name, part), bool)
            ranks = np.where(correct.any(axis=1), np.argmax(correct, axis=1) + 1, 0)
            columns += [correct[:, 0].astype(int).tolist(), [rank or "" for rank in ranks.tolist()]]
        write_csv(evaluation.folder(folder, part) / "gains.csv", header, zip(*columns, strict=True))
    tests, counts = differences(evaluation), {}
    for first, second, test, path in tests:
        counts[first, second] = f"{test.only_first} (p {path.p_value:.2g})"
        counts[second, first] = f"{test.only_second} (p {path.p_value:.2g})"
    rows = [[name, *(counts.get((name, other), "") for other in systems)] for name in systems]
    header = ["system", "other", "only_system", "only_other", "mcnemar_p", "design_effect", "path_p"]
    write_csv(folder / "differences.csv", header, [test.cells for test in tests])
    write_text(folder / "differences.md", Table(["only this is correct, not", *systems], rows).markdown())
