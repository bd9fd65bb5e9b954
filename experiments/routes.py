"""Recall of `Route` beside that of each image alone, from the predictions of `mfvpr evaluate`.

The runs are of drives whose query i shows database image i. Their queries are taken as they are, every fourth, every
second backwards, with stops, and in clips of 25 in another order.
"""

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from mfvpr.cli.launch import Parser, run_command
from mfvpr.localization import Alternative, Drive, Prediction, Route
from mfvpr.localization.route import NEAR


def drives(rows: np.ndarray) -> dict[str, tuple[np.ndarray, float | None]]:
    """Rows of the query images of each drive, and its speed if it is constant."""
    stops = np.repeat(rows, 1 + 2 * ((rows > len(rows) // 3) & (rows < len(rows) // 2)))
    clips = np.concatenate([rows[start : start + 25] for start in (50, 0, 75, 25)])
    return {"as they are": (rows, 1), "every fourth": (rows[::4], 4), "every second, backwards": (rows[::-2], -2),
            "with stops": (stops, None), "clips": (clips, None)}  # fmt: skip


def read_predictions(path: Path) -> Iterator[list[Prediction]]:
    """The predictions of each sequence of a run, in the order of its queries."""
    for file in sorted(path.glob("sequences/*/predictions.csv")) or [path / "predictions.csv"]:
        queries: dict[str, list[tuple[str, float]]] = {}
        with file.open(newline="", encoding="utf-8") as stream:
            for line in csv.DictReader(stream):
                queries.setdefault(line["query"], []).append((line["database"], float(line["score"] or "nan")))
        names = sorted({name for candidates in queries.values() for name, _ in candidates})
        rows = {name: row for row, name in enumerate(names)}
        yield [
            Prediction(None, tuple(Alternative(rows[name], name, name, score) for name, score in candidates),
                       0.0, None, None, None, None)
            for candidates in queries.values()
        ]  # fmt: skip


def recall(predictions: list[Prediction], images: np.ndarray, speed: float | None) -> Mapping[str, float]:
    """Share of the images whose row is predicted, alone and on routes."""
    there = np.ones(1 + max(each.row for prediction in predictions for each in prediction.alternatives), bool)
    by_route = {"alone": [predictions[image].alternatives[0].row for image in images]}
    for name, drive in {"learned": Drive(), "given": Drive(speed), "given 1": Drive(1)}.items():
        if name != "given" or speed is not None:
            route = Route(drive, warn=lambda _: None)
            by_route[name] = [located.row for image in images if (located := route(predictions[image], there))]
    return {name: float(np.mean(np.abs(np.array(rows) - images) <= NEAR)) for name, rows in by_route.items()}


def run(runs: list[Path]) -> None:
    """Print a table of all runs."""
    print("| run | drive | alone | speed learned | speed given | speed 1 given |")
    print("| :-- | :-- | --: | --: | --: | --: |")
    for path in runs:
        sequences = list(read_predictions(path))
        for drive in drives(np.arange(len(sequences[0]))):
            results = [recall(each, *drives(np.arange(len(each)))[drive]) for each in sequences]
            cells = [f"{100 * np.mean([result[name] for result in results]):.1f}" if name in results[0] else "-"
                     for name in ("alone", "learned", "given", "given 1")]  # fmt: skip
            print(f"| {path.name} | {drive} | {' | '.join(cells)} |")


def add_arguments(parser: Parser) -> None:
    """Declare the command line."""
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of mfvpr evaluate")
    parser.set_defaults(run="experiments.routes:run")


if __name__ == "__main__":
    run_command("python -m experiments.routes", str(__doc__), add_arguments)
