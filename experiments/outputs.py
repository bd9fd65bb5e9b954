"""What a run leaves: rows of results, the table, predictions and figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import build
from mfvpr.data.datasets import Dataset
from mfvpr.data.files import write_text
from mfvpr.data.ground_truth import Unit, threshold_words
from mfvpr.data.images import resize
from mfvpr.evaluation import recall_at_k
from mfvpr.features import LocalExtractor
from mfvpr.pipeline import FeatureSet, MatchSet, explain
from mfvpr.report import runs
from mfvpr.report.figures import histogram_figure
from mfvpr.report.tables import Table
from mfvpr.scoring import HistogramOfShifts, Scorer
from mfvpr.types import Shortlist

_UNITS: dict[Unit, str] = {"frames": ", ± in frames", "m": ", ± in m", "exact": ""}
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

    @property
    def thresholds(self) -> list[float]:
        """What counts as right, in the unit of the ground truth; none without ground truth."""
        if self.dataset.truth is None:
            return []
        recall = self.settings["recall"]
        return self.dataset.truth.thresholds(tolerances=recall["tolerances"], radius=recall["radius"])

    @property
    def headline(self) -> str:
        """The system of predictions.csv and of the figures: the histogram, else the scorer that was asked for."""
        if self.settings["final"] == "combined":
            return next(name for name in self.systems if name.endswith(" + filter"))
        return "histogram" if "histogram" in self.systems else list(self.systems)[1]


def heading(outcome: Outcome) -> str:
    """One line that says what was evaluated."""
    truth, settings = outcome.dataset.truth, outcome.settings
    kind = "no ground truth: rankings only" if truth is None else f"recall in %{_UNITS[truth.unit]}"
    return (
        f"{outcome.dataset.name}: {len(outcome.queries)} queries, {len(outcome.database)} database images, "
        f"{outcome.candidates.indices.shape[1]} candidates ({settings['retrieval']['name']}), "
        f"{settings['features']['name']} features; {kind}"
    )


def write(folder: Path, outcome: Outcome) -> Table:
    """All files of a run folder; the table comes back to be printed."""
    rows = result_rows(outcome)
    table = recall_table(rows)
    runs.write_results(folder, rows)
    if outcome.thresholds:
        runs.write_table(folder, table)
    _write_predictions(folder, outcome)
    _write_skipped(folder, outcome)
    _write_figures(folder, outcome)
    return table


def result_rows(outcome: Outcome) -> list[dict[str, Any]]:
    """One row per system and threshold."""
    settings, truth = outcome.settings, outcome.dataset.truth
    common = {
        "filter": settings["retrieval"],
        "features": settings["features"],
        "matching": settings["matching"],
        "candidates": int(outcome.candidates.indices.shape[1]),
        "queries": len(outcome.queries),
        "database": len(outcome.database),
        "dataset": outcome.dataset.name,
        "data_fingerprint": outcome.fingerprint,
        "reading": outcome.reading,
        "seconds": outcome.seconds,
        "versions": runs.versions(),
    }
    judged: list[tuple[dict[str, float], dict[str, dict[str, float]]]] = [({}, {})]
    if truth is not None:
        name = _THRESHOLDS.get(truth.unit)
        judged = [
            ({name: value} if name else {}, _recall(outcome, truth.positives(value))) for value in outcome.thresholds
        ]
    return [
        {"system": name, "scorer": system.scorer, "parameters": system.parameters, **threshold,
         "recall_at": recall.get(name, {}), **common}
        for name, system in outcome.systems.items()
        for threshold, recall in judged
    ]  # fmt: skip


def _recall(outcome: Outcome, positives: np.ndarray) -> dict[str, dict[str, float]]:
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
            return f"R@{k}" + "".join(
                threshold_words(unit, row[name]) for unit, name in _THRESHOLDS.items() if name in row
            )

        first = [(row, k) for row in found for k in list(row["recall_at"])[:1]]
        others = [(found[middle], k) for k in list(found[middle]["recall_at"])[1:]]
        return [(label(row, k), f"{100 * row['recall_at'][k]:.1f}") for row, k in first + others]

    header = ["system", *(name for name, _ in cells(per_system[0]))]
    lines = zip(systems, per_system, strict=True)
    return Table(header, [[system, *(text for _, text in cells(found))] for system, found in lines])


def _write_predictions(folder: Path, outcome: Outcome) -> None:
    names = outcome.dataset.queries.names, outcome.dataset.database.names
    for name, system in outcome.systems.items():
        file = folder / "predictions" / f"{name.replace(' + ', '_')}.csv"
        runs.write_predictions(file, *names, system.rows, system.scores)
    headline = outcome.systems[outcome.headline]
    runs.write_predictions(folder / "predictions.csv", *names, headline.rows, headline.scores)


def _write_skipped(folder: Path, outcome: Outcome) -> None:
    sides = (
        ("database", outcome.dataset.database, outcome.database),
        ("queries", outcome.dataset.queries, outcome.queries),
    )
    bad = [(side, images.names[row], why) for side, images, found in sides for row, why in found.bad.items()]
    if bad:
        write_text(folder / "skipped.csv", Table(["folder", "image", "reason"], bad).csv())


def _write_figures(folder: Path, outcome: Outcome) -> None:
    """The paper's figure for a few queries, right and wrong ones, spread over the sequence."""
    queries, database = outcome.dataset.queries, outcome.dataset.database
    scorer = outcome.scorers.get("histogram")
    scorer = scorer if isinstance(scorer, HistogramOfShifts) else HistogramOfShifts()
    size, interpolation = outcome.extractor.image_size, outcome.extractor.interpolation
    best = outcome.systems[outcome.headline].rows[:, 0]
    shown = _shown(outcome, best)
    for query, verdict in build.track("figures")(shown.items(), len(shown)) if shown else ():
        place = int(np.flatnonzero(outcome.candidates.indices[query] == best[query])[0])
        pair = jax.tree.map(lambda field: field[place], outcome.matches[query])  # noqa: B023
        histogram_figure(
            folder / "figures" / f"{verdict.split()[0]}_{query:04d}.png",
            resize(queries.read(query), size, interpolation),
            resize(database.read(int(best[query])), size, interpolation),
            pair,
            explain(scorer, pair),
            title=f"{outcome.headline}, {verdict}: {queries.names[query]} -> {database.names[best[query]]}",
        )


def _shown(outcome: Outcome, best: np.ndarray) -> dict[int, str]:
    """Queries that get a figure, with what became of them: half right, half wrong where that can be told."""
    number, found, truth = outcome.settings["figures"], best >= 0, outcome.dataset.truth
    if truth is None:
        return dict.fromkeys(_spread(np.flatnonzero(found), number), "best")
    positives = truth.positives(outcome.thresholds[len(outcome.thresholds) // 2])
    right = positives[np.arange(len(best)), np.maximum(best, 0)] & found
    shown = dict.fromkeys(_spread(np.flatnonzero(right), (number + 1) // 2), "right")
    for query in _spread(np.flatnonzero(found & ~right), number // 2):
        place = truth.place(query)
        shown[query] = f"wrong (truth: {'nowhere' if place is None else outcome.dataset.database.names[place]})"
    return shown


def _spread(items: np.ndarray, number: int) -> list[int]:
    """At most `number` of the items, evenly spaced."""
    places = np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int)
    return [int(items[place]) for place in places]
