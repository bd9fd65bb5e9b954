"""The paper's figures, of what was evaluated here."""

import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.paper.printed import average, printed
from experiments.paper.systems import Row
from experiments.paper.tables import TOLERANCES, Found, listed
from mfvpr.datasets import Dataset, ImageFolder, QuerySequence, resize
from mfvpr.report import runs
from mfvpr.report.evaluations import sequence_folder
from mfvpr.utils.files import clipped, printable, replacing

_MIDDLE = 1  # of the tolerances: the paper's figure
_OURS, _THEIRS = "#2f6fb0", "#c9a227"
_STEPS = {"filter": "#7a9e9f", "features": "#c98b2d", "matching": "#2f6fb0", "scores": "#7b4b94"}
_SIDE = 300  # px of an image's longer side among the failures
_LONGEST = 32  # characters of a name


def figures(found: Found, best: Mapping[str, Path], growth: Mapping[str, Mapping[int, float]]) -> Iterator[runs.Figure]:
    """Those for which there are numbers.

    Args:
        found: what was evaluated.
        best: the run folder by data set whose histograms and failures are shown.
        growth: seconds of a query by title and by the size of the database.
    """
    histograms = (path for folder in best.values() for path in sorted((folder / "figures").rglob("right_*.png")))
    if histogram := next(histograms, None):
        yield "histogram.png", partial(_copy, source=histogram)
    if bars := mean_bars(found):
        yield "averages.png", partial(draw_averages, bars=bars, names=listed(found))
    if found.seconds:
        yield "speed.png", partial(draw_speed, rows=found.rows, seconds=found.seconds, about=found.timed_on)
    if growth:
        yield "growth.png", partial(draw_growth, growth=growth)
    if best:
        yield "failures.png", partial(draw_failures, datasets=found.datasets, best=best)


def mean_bars(found: Found) -> list[tuple[str, float | None, float | None]]:
    """(title, mean here, see `Found.means`, the printed mean) within 2 frames, of rows that have one."""
    bars = []
    for row in found.rows:
        ours, theirs = found.means[1].get(row.name), average(printed()["recall"].get(row.name, {}))
        if ours is not None or theirs is not None:
            bars.append((row.title, *(None if one is None else float(one[_MIDDLE]) for one in (ours, theirs))))
    return bars


def draw_averages(path: Path, bars: Sequence[tuple[str, float | None, float | None]], names: str) -> None:
    """Mean recall within 2 frames over the data sets that are named, beside the paper's over its own six."""
    figure, axes = _canvas(9, 1.2 + 0.3 * len(bars))
    places = np.arange(len(bars))
    sides = [(f"over {names}", 1, _OURS), ("printed, over the paper's six", 2, _THEIRS)]
    sides = [side for side in sides if any(bar[side[1]] is not None for bar in bars)]
    for turn, (label, at, color) in enumerate(sides):
        shift = 0.4 * (turn - (len(sides) - 1) / 2)
        axes.barh(places + shift, [float(bar[at] or 0) for bar in bars], 0.38, label=label, color=color)
        for place, bar in zip(places, bars, strict=True):
            if (value := bar[at]) is not None:
                axes.text(float(value) + 0.5, place + shift, f"{value:.1f}", va="center", fontsize=7)
    axes.set_yticks(places, [bar[0] for bar in bars], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 108)
    axes.set_xlabel("mean Recall@1 within 2 frames, %")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize=8)
    _save(figure, path)


def draw_speed(path: Path, rows: Sequence[Row], seconds: Mapping[str, Mapping[str, float]], about: str) -> None:
    """Seconds of a query, step by step; `about` = of what, on what."""
    shown = [row for row in rows if row.name in seconds]
    figure, axes = _canvas(9, 1.2 + 0.3 * len(shown))
    left = np.zeros(len(shown))
    for step, color in _STEPS.items():
        width = np.array([seconds[row.name][step] for row in shown])
        axes.barh(np.arange(len(shown)), width, 0.7, left=left, label=step, color=color)
        left += width
    for place, total in enumerate(left):
        axes.text(total, place, f" {total:.3f}", va="center", fontsize=7)
    axes.set_yticks(np.arange(len(shown)), [row.title for row in shown], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.12 * left.max())
    axes.set_xlabel(f"seconds of a query of {about}")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=len(_STEPS), frameon=False, fontsize=8)
    _save(figure, path)


def draw_growth(path: Path, growth: Mapping[str, Mapping[int, float]]) -> None:
    """Seconds of a query as the database grows: the search grows, the rest stays."""
    figure, axes = _canvas(7, 4.2)
    for title, by_size in growth.items():
        axes.loglog([*by_size], [*by_size.values()], marker="o", markersize=3, label=title)
    axes.set_xlabel("images of a database, whose descriptors are made up")
    for set_formatter in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        set_formatter("{x:g}")
    axes.set_ylabel("seconds of a query")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    _save(figure, path)


def draw_failures(path: Path, datasets: Mapping[str, Dataset], best: Mapping[str, Path], each: int = 2) -> None:
    """Query, answer, and the best ranked of the right images, where the answer scores higher than that."""
    cases = [(name, *case) for name, folder in best.items() for case in _failures(folder, datasets[name], each)]
    shown = [
        [_small(folder, image) for folder, image in zip(_folders(datasets[name], sequence), images, strict=True)]
        for name, sequence, *images in cases
    ]
    heights = [0.35 + 3.1 * max(image.shape[0] / image.shape[1] for image in images) for images in shown] or [1.0]
    figure = Figure(figsize=(9.5, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(heights), 3, squeeze=False, height_ratios=heights)
    for axes, images, (name, sequence, *names) in zip(rows, shown, cases, strict=False):
        for one, image, file, word in zip(axes, images, names, ("query", "answer", "right"), strict=True):
            one.imshow(image)
            where = " ".join(dict.fromkeys((name, sequence.name))) if word == "query" else ""
            title = f"{where} {word}: {clipped(file, _LONGEST)}".strip()
            one.set_title(printable(title), fontsize=7, parse_math=False)
    for one in rows.ravel():
        one.set_axis_off()
    _save(figure, path)


def _folders(dataset: Dataset, sequence: QuerySequence) -> tuple[ImageFolder, ImageFolder, ImageFolder]:
    return sequence.images, dataset.database, dataset.database


def _failures(run: Path, dataset: Dataset, number: int) -> Iterator[tuple[QuerySequence, str, str, str]]:
    """(sequence, query, answer, right answer) of the clearest failures that the filter did not cause."""
    names, rows = [sequence.name for sequence in dataset.sequences], []
    for place, sequence in enumerate(dataset.sequences):
        file = sequence_folder(run, names, place) / "failures" / "histogram.csv"
        with file.open(newline="", encoding="utf-8", errors="surrogateescape") as lines:
            rows += [(sequence, row) for row in csv.DictReader(lines)
                     if row["right_answer"] and _is_far(sequence, dataset.database, row)]  # fmt: skip
    rows.sort(key=lambda row: -float(row[1]["margin"]))
    yield from ((sequence, row["query"], row["answer"], row["right_answer"]) for sequence, row in rows[:number])


def _is_far(sequence: QuerySequence, database: ImageFolder, row: Mapping[str, str]) -> bool:
    """Whether an answer is wrong within the widest of the paper's tolerances, too; of positions it is."""
    if sequence.truth is None or sequence.truth.unit != "frames":
        return True
    right = sequence.truth.positives(TOLERANCES[-1]).of(sequence.images.names.index(row["query"]))
    return database.names.index(row["answer"]) not in right


def _copy(path: Path, source: Path) -> None:
    with replacing(path) as temporary:
        shutil.copyfile(source, temporary)


def _small(folder: ImageFolder, name: str) -> np.ndarray:
    image = folder.read(folder.names.index(name))
    scale = _SIDE / max(image.shape[:2])
    return resize(image, (round(image.shape[1] * scale), round(image.shape[0] * scale)))


def _canvas(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots()


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)
