"""What a run leaves: rows of results, the table, predictions and figures."""

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import truth
from experiments.run_folder import Figure
from experiments.settings import SettingsError
from mfvpr.data.datasets import Dataset, ImageFolder
from mfvpr.data.files import write_text
from mfvpr.data.images import resize
from mfvpr.evaluation import Positives, Unit, recall_at_k, threshold_words
from mfvpr.features import LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet, explain
from mfvpr.report import runs
from mfvpr.report.figures import Answer, histogram_figure
from mfvpr.report.rankings import Rankings, write_failures, write_predictions
from mfvpr.report.tables import Table
from mfvpr.scoring import HistogramOfShifts, Scorer
from mfvpr.types import Shortlist

_THRESHOLDS: dict[Unit, str] = {"frames": "tolerance", "m": "radius"}  # their names in results


@dataclass(frozen=True)
class System:
    """One line of the table: a ranking and what made it."""

    scorer: str
    parameters: dict[str, Any]
    rows: np.ndarray  # [Q, C] database rows, best first
    scores: np.ndarray  # [Q, C] in that order


@dataclass(frozen=True)
class Outcome:
    """Everything that one evaluation made."""

    settings: dict[str, Any]
    dataset: Dataset
    extractor: LocalExtractor
    database: FeatureSet
    queries: FeatureSet
    candidates: Shortlist
    matches: MatchSet
    scorers: dict[str, Scorer]
    systems: dict[str, System]
    seconds: dict[str, float]
    fingerprint: dict[str, str]  # of the images
    reading: dict[str, Any]  # what it did to them
    shown: int | list[int]  # figures: how many, or of which queries

    @cached_property
    def thresholds(self) -> list[float]:
        """What counts as right, in the unit of the ground truth; none without ground truth."""
        return truth.thresholds(self.settings, self.dataset.truth)

    @property
    def threshold(self) -> float:
        """The one in the middle, which predictions, failures and figures go by."""
        return self.thresholds[len(self.thresholds) // 2]

    @cached_property
    def right(self) -> Positives | None:
        """By `threshold`."""
        found = self.dataset.truth
        return None if found is None else found.positives(self.threshold)

    def is_right(self, system: "System") -> np.ndarray | None:
        """`[Q, C]` bool in the order of a ranking."""
        return None if self.right is None else self.right.contains(system.rows)

    @property
    def headline(self) -> str:
        """The system of predictions.csv and of the figures: the histogram, else the scorer that was asked for."""
        if self.settings["final"] == "combined":
            return next(name for name in self.systems if name.endswith(" + filter"))
        return "histogram" if "histogram" in self.systems else list(self.systems)[1]


def text(outcome: Outcome) -> str:
    """For the terminal: what was evaluated, and the table."""
    table = f"\n{recall_table(result_rows(outcome)).text()}" if outcome.thresholds else ""
    return f"{heading(outcome)}\n{table}"


def heading(outcome: Outcome) -> str:
    """One line that says what was evaluated."""
    settings = outcome.settings
    return (
        f"{outcome.dataset.name}: {len(outcome.queries)} queries, {len(outcome.database)} database images, "
        f"{outcome.candidates.indices.shape[1]} candidates ({settings['retrieval']['name']}), "
        f"{settings['features']['name']} features; {truth.in_words(settings, outcome.dataset)}"
    )


def write(folder: Path, outcome: Outcome) -> None:
    """All files of a run folder but the figures."""
    rows = result_rows(outcome)
    runs.write_json(folder / "results.json", rows)
    if outcome.thresholds:
        runs.write_table(folder, recall_table(rows), heading(outcome))
    _write_rankings(folder, outcome)
    _write_skipped(folder, outcome)


def result_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """One row per system and threshold."""
    settings, found = outcome.settings, outcome.dataset.truth
    common = {
        "filter": settings["retrieval"],
        "features": settings["features"],
        "matching": settings["matching"],
        "candidates": int(outcome.candidates.indices.shape[1]),
        "queries": len(outcome.queries),
        "database": len(outcome.database),
        "dataset": outcome.dataset.name,
        "data_fingerprint": outcome.fingerprint,
        "ground_truth": truth.described(settings, outcome.dataset),
        "reading": outcome.reading,
        "seconds": outcome.seconds,
        "versions": runs.versions(),
    }
    judged: list[tuple[dict[str, float], dict[str, dict[str, float]]]] = [({}, {})]
    if found is not None:
        name = _THRESHOLDS.get(found.unit)
        judged = [
            ({name: value} if name else {}, _recall(outcome, found.positives(value))) for value in outcome.thresholds
        ]
    return [
        {"system": name, "scorer": system.scorer, "parameters": system.parameters, **threshold,
         "recall_at": recall.get(name, {}), **common}
        for name, system in outcome.systems.items()
        for threshold, recall in judged
    ]  # fmt: skip


def _recall(outcome: Outcome, positives: Positives) -> dict[str, dict[str, float]]:
    """Recall@K by system and K."""
    ks = sorted(set(outcome.settings["recall"]["ks"]))

    def of(rows: np.ndarray) -> dict[str, float]:
        return {str(k): round(float(value), 6) for k, value in zip(ks, recall_at_k(rows, positives, ks), strict=True)}

    return {name: of(system.rows) for name, system in outcome.systems.items()}


def recall_table(rows: list[dict[str, Any]]) -> Table:
    """R@first k at every tolerance, and all ks at the middle one."""
    systems = list(dict.fromkeys(row["system"] for row in rows))
    per_system = [[row for row in rows if row["system"] == system] for system in systems]
    middle = len(per_system[0]) // 2

    def cells(found: list[dict[str, Any]]) -> list[tuple[str, str]]:
        def label(row: dict[str, Any], k: str) -> str:
            threshold = next((row[name] for name in _THRESHOLDS.values() if name in row), 0)
            return f"R@{k}{threshold_words(row['ground_truth']['unit'], threshold)}"

        first = [(row, k) for row in found for k in list(row["recall_at"])[:1]]
        others = [(found[middle], k) for k in list(found[middle]["recall_at"])[1:]]
        return [(label(row, k), f"{100 * row['recall_at'][k]:.1f}") for row, k in first + others]

    header = ["system", *(name for name, _ in cells(per_system[0]))]
    lines = zip(systems, per_system, strict=True)
    return Table(header, [[system, *(text for _, text in cells(found))] for system, found in lines])


def _write_rankings(folder: Path, outcome: Outcome) -> None:
    names = outcome.dataset.queries.names, outcome.dataset.database.names
    for name, system in outcome.systems.items():
        found = Rankings(*names, system.rows, system.scores, outcome.is_right(system))
        file = f"{name.replace(' + ', '_')}.csv"
        write_predictions(folder / "predictions" / file, found)
        write_failures(folder / "failures" / file, found)
        if name == outcome.headline:
            write_predictions(folder / "predictions.csv", found)
            write_failures(folder / "failures.csv", found)


def _write_skipped(folder: Path, outcome: Outcome) -> None:
    sides = (
        ("database", outcome.dataset.database, outcome.database),
        ("queries", outcome.dataset.queries, outcome.queries),
    )
    bad = [(side, images.names[row], why) for side, images, found in sides for row, why in found.bad.items()]
    if bad:
        write_text(folder / "skipped.csv", Table(["folder", "image", "reason"], bad).csv())


def asked_figures(asked: int | list[int | str], dataset: Dataset) -> int | list[int]:
    """How many figures, or of which queries, as rows; what is asked for may be names."""
    if isinstance(asked, int):
        return asked
    names = {name: row for row, name in enumerate(dataset.queries.names)}
    rows = [names.get(one, -1) if isinstance(one, str) else one for one in asked]
    for one, row in zip(asked, rows, strict=True):
        if not 0 <= row < len(names):
            raise SettingsError(
                f"figures=[{one}]: expected rows of queries from 0 to {len(names) - 1}, or names such as "
                f"{dataset.queries.names[0]}"
            )
    return list(dict.fromkeys(rows))


def figures(outcome: Outcome) -> list[Figure]:
    """The paper's figure for a few queries, right and wrong ones, spread over the sequence."""
    return [
        (f"{verdict}_{query:04d}.png", partial(_draw, outcome=outcome, query=query, verdict=verdict))
        for query, verdict in _shown(outcome).items()
    ]


def _draw(path: Path, outcome: Outcome, query: int, verdict: str) -> None:
    """What was answered; where that is wrong, below it what is right."""
    system, names = outcome.systems[outcome.headline], outcome.dataset.queries.names
    answers = [_answer(outcome, query, 0, verdict)]
    if verdict == "wrong":
        answers += _right_answer(outcome, query)
    image = _image(outcome, outcome.dataset.queries, query)
    found = outcome.dataset.truth
    within = "" if found is None else threshold_words(found.unit, outcome.threshold)
    verdict += " at" * bool(within) + within
    answer = outcome.dataset.database.names[system.rows[query, 0]]
    title = f"{outcome.headline}, {verdict}: {names[query]} -> {answer}"
    histogram_figure(path, image, answers, title=title)


def _answer(outcome: Outcome, query: int, rank: int, verdict: str) -> Answer:
    """The candidate at a rank from 0."""
    system, database = outcome.systems[outcome.headline], outcome.dataset.database
    row = int(system.rows[query, rank])
    place = int(np.flatnonzero(outcome.candidates.indices[query] == row)[0])
    pair = jax.tree.map(lambda field: field[place], outcome.matches[query])
    scorer = outcome.scorers.get("histogram")
    scorer = scorer if isinstance(scorer, HistogramOfShifts) else HistogramOfShifts()
    caption = f"{verdict}: {database.names[row]}, rank {rank + 1}, score {system.scores[query, rank]:.5g}"
    return Answer(_image(outcome, database, row), caption, pair, explain(scorer, pair))


def _right_answer(outcome: Outcome, query: int) -> list[Answer]:
    """The first right candidate; else the right image, which the filter missed; nothing where there is none."""
    ranked, found = outcome.is_right(outcome.systems[outcome.headline]), outcome.dataset.truth
    if ranked is None or outcome.right is None or found is None or not len(right := outcome.right.of(query)):
        return []
    if ranked[query].any():
        return [_answer(outcome, query, int(np.argmax(ranked[query])), "right")]
    nearest = found.place(query)
    row = nearest if nearest is not None and nearest in right else int(right[0])
    database, num_candidates = outcome.dataset.database, outcome.candidates.indices.shape[1]
    caption = f"right: {database.names[row]}, not among the {num_candidates} candidates"
    return [Answer(_image(outcome, database, row), caption, None, None)]


def _image(outcome: Outcome, folder: ImageFolder, row: int) -> np.ndarray:
    size, interpolation = outcome.extractor.image_size, outcome.extractor.interpolation
    return resize(folder.read(row), size, interpolation)


def _shown(outcome: Outcome) -> dict[int, str]:
    """Queries that get a figure, with what became of them: half right, half wrong where that can be told."""
    system, asked = outcome.systems[outcome.headline], outcome.shown
    found, right = system.rows[:, 0] >= 0, outcome.is_right(system)
    verdicts = np.full(len(found), "best") if right is None else np.where(right[:, 0], "right", "wrong")
    if isinstance(asked, list):
        return {query: str(verdicts[query]) for query in asked if found[query]}
    numbers = {"best": asked} if right is None else {"right": (asked + 1) // 2, "wrong": asked // 2}
    return {query: verdict for verdict, number in numbers.items()
            for query in _spread(np.flatnonzero(found & (verdicts == verdict)), number)}  # fmt: skip


def _spread(items: np.ndarray, number: int) -> list[int]:
    """At most `number` of the items, evenly spaced."""
    places = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [int(items[place]) for place in places]
