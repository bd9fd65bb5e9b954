"""The figures of the evaluations at hand; the page of all of them, and one of each data set's side by side."""

import itertools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure as Canvas

from experiments.paper.tables import TOLERANCES, Evaluations, average, printed_tables
from mfvpr.datasets import Dataset, ImageFolder
from mfvpr.datasets.ground_truth import middle, threshold_words
from mfvpr.evaluation.statistics import Estimate
from mfvpr.report import Table
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.figures import with_longest_side
from mfvpr.report.pages import write_comparison
from mfvpr.report.plots import panels, save_figure
from mfvpr.report.rendering import (
    MOST_PICTURES,
    PAGE,
    Chart,
    Gallery,
    Section,
    bar_chart,
    embed,
    pictures,
    values_table,
    write_page,
)
from mfvpr.report.runs import Figure
from mfvpr.report.tables import read_csv
from mfvpr.utils.files import clip_middle, printable
from mfvpr.utils.fingerprints import versions

_COSTS, _ABOUT = ("sizes", "seconds"), ("data_sets", "settings")  # names of tables
_MIDDLE = 1  # of the tolerances: the paper's figure
_OVER_PAPERS = "printed, over the paper's six"
_OURS, _PRINTED = "#2f6fb0", "#c9a227"
_STEPS = {"retrieval": "#7a9e9f", "features": "#c98b2d", "matching": "#2f6fb0", "scores": "#7b4b94"}
_SIDE = 300  # px of an image's longer side among the failures
_NAME_LENGTH = 32  # characters
_FAILURES = 2  # of each data set

_Image = tuple[np.ndarray, str]  # pixels and a title


def paper_figures(evaluations: Evaluations) -> Iterator[Figure]:
    """The figures that there are numbers for; of each data set, the best row shows its histogram and failures."""
    folders = {
        name: evaluations.folders[name, row.run]
        for name in evaluations.datasets
        for row in reversed(evaluations.best_rows)
        if (name, row.run) in evaluations.folders
    }
    histograms = (path for folder in folders.values() for path in sorted((folder / "figures").rglob("correct_*.png")))
    if histogram := next(histograms, None):
        yield "histogram.png", partial(shutil.copyfile, histogram)
    if groups := mean_recalls(evaluations):
        titles = [row.title for row in evaluations.rows if any(row.title in group for group in groups.values())]
        yield "averages.png", partial(_draw_averages, titles=titles, groups=groups)
    if evaluations.seconds:
        yield "speed.png", partial(_draw_speed, evaluations=evaluations)
    if folders:
        cases = [case for name, folder in folders.items() for case in _failures(folder, evaluations.datasets[name])]
        yield "failures.png", partial(_draw_failures, cases=cases)


def mean_recalls(evaluations: Evaluations) -> dict[str, dict[str, float]]:
    """Mean recall at 1 within 2 frames by title, here (see `Evaluations.means`) and printed, as far as there are."""
    groups: dict[str, dict[str, float]] = {f"over {evaluations.averaged}": {}, _OVER_PAPERS: {}}
    for row in evaluations.rows:
        means = evaluations.means[1].get(row.name), average(printed_tables()["recall"].get(row.name, {}))
        for group, mean in zip(groups.values(), means, strict=True):
            if mean is not None:
                group[row.title] = float(mean[_MIDDLE])
    return {label: group for label, group in groups.items() if group}


def _draw_averages(path: Path, titles: Sequence[str], groups: Mapping[str, Mapping[str, float]]) -> None:
    """Draw the means of `mean_recalls` side by side."""
    figure, [axes] = panels(1, 9, 1.2 + 0.3 * len(titles))
    for number, (label, members) in enumerate(groups.items()):
        places = [titles.index(title) + 0.4 * (number - (len(groups) - 1) / 2) for title in members]
        color = _PRINTED if label == _OVER_PAPERS else _OURS
        bars = axes.barh(places, [*members.values()], 0.38, label=label, color=color)
        axes.bar_label(bars, fmt="%.1f", padding=2, fontsize=7)
    _save_bars(figure, path, titles, "mean Recall@1 within 2 frames, %", 108)


def _draw_speed(path: Path, evaluations: Evaluations) -> None:
    """Draw the seconds of a query, step by step."""
    rows = [row for row in evaluations.rows if row.name in evaluations.seconds]
    figure, [axes] = panels(1, 9, 1.2 + 0.3 * len(rows))
    left = np.zeros(len(rows))
    for step, color in _STEPS.items():
        width = np.array([evaluations.seconds[row.name][step] for row in rows])
        axes.barh(np.arange(len(rows)), width, 0.7, left=left, label=step, color=color)
        left += width
    for place, total in enumerate(left):
        axes.text(total, place, f" {total:.3f}", va="center", fontsize=7)
    label = f"seconds of a query of {evaluations.timed_on}"
    _save_bars(figure, path, [row.title for row in rows], label, 1.12 * left.max())


def _save_bars(figure: Canvas, path: Path, titles: Sequence[str], label: str, limit: float) -> None:
    [axes] = figure.axes
    axes.set_yticks(np.arange(len(titles)), titles, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, limit), xlabel=label)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=len(_STEPS), frameon=False, fontsize=8)
    save_figure(figure, path)


def _draw_failures(path: Path, cases: Sequence[Sequence[_Image]]) -> None:
    """Draw query, prediction, and the best ranked correct image side by side."""
    heights = [0.35 + 3.1 * max(image.shape[0] / image.shape[1] for image, _ in case) for case in cases] or [1.0]
    number = len(heights)
    figure, axes = panels(3 * number, 9.5 / 3, sum(heights) / number, columns=3, height_ratios=heights)
    for panel in axes:
        panel.set_axis_off()
    for panel, (image, title) in zip(axes, itertools.chain.from_iterable(cases), strict=False):
        panel.imshow(image)
        panel.set_title(printable(title), fontsize=7, parse_math=False)
    save_figure(figure, path)


def _failures(run: Path, dataset: Dataset) -> Iterator[list[_Image]]:
    """Query, prediction and correct image of the clearest failures that retrieval did not cause."""
    names, failures = [sequence.name for sequence in dataset.sequences], []
    for place, sequence in enumerate(dataset.sequences):
        is_of_frames = sequence.truth is not None and sequence.truth.unit == "frames"
        positives = sequence.truth.positives(TOLERANCES[-1]) if sequence.truth and is_of_frames else None
        for row in read_csv(sequence_folder(run, names, place) / "failures" / "histogram.csv"):
            if not row["correct_image"]:  # nor need there be a prediction
                continue
            near = () if positives is None else positives.of(sequence.images.names.index(row["query"]))
            if dataset.database.names.index(row["prediction"]) not in near:  # also within the widest tolerance
                failures.append((sequence, row))
    failures.sort(key=lambda failure: -float(failure[1]["margin"] or 0))  # empty between two infinite scores
    for sequence, row in failures[:_FAILURES]:
        where = " ".join(dict.fromkeys((dataset.name, sequence.name)))
        yield [
            _image(sequence.images, row["query"], f"{where} query"),
            _image(dataset.database, row["prediction"], "prediction"),
            _image(dataset.database, row["correct_image"], "correct"),
        ]


def _image(folder: ImageFolder, name: str, words: str) -> _Image:
    """An image, small, and its title."""
    image = with_longest_side(folder.read(folder.names.index(name)), _SIDE)
    return image, f"{words}: {clip_middle(name, _NAME_LENGTH)}"


def write_pages(
    out: Path, evaluations: Evaluations, tables: Mapping[str, tuple[str, Table]], left_out: Sequence[str]
) -> None:
    """Write `report.html` of all evaluations, and in `comparisons/` a page of each data set's evaluations side by side.

    `tables` are (heading, table) by name; `left_out` are lines "<evaluation>: <reason>".
    """
    links: list[tuple[str, Path]] = []
    for dataset in dict.fromkeys(name for name, _ in evaluations.folders):
        folders = {run: folder for (name, run), folder in evaluations.folders.items() if name == dataset}
        if len(folders) > 1:
            links.append((f"{dataset}: all side by side", out / "comparisons" / f"{dataset}.html"))
            write_comparison([*folders.values()], links[-1][1])
        links += [(f"{dataset}: {run}", folder / PAGE) for run, folder in folders.items()]
    addresses = [(words, quote(path.relative_to(out).as_posix())) for words, path in links if path.is_file()]

    recalls = dict(table for name, table in tables.items() if name not in (*_COSTS, *_ABOUT))
    costs, about = (dict(tables[name] for name in names if name in tables) for names in (_COSTS, _ABOUT))
    if left_out:
        rows = [[*line.partition(": ")[::2]] for line in left_out]
        about["Left out"] = Table(["what", "why"], rows, text_columns=2)
    about["Versions"] = values_table(versions())
    paths = {path.stem: path for path in (out / "figures").glob("*.png")}
    averages = {"Mean recall at 1 within 2 frames": embed(paths["averages"])} if "averages" in paths else {}
    speed = {"Seconds of a query": embed(paths["speed"])} if "speed" in paths else {}
    words = "In %. Where the paper prints a number, that and the difference stand beside ours."
    sections = [Section("recall", "Recall", words, [*_by_sequence(evaluations)], recalls, images=averages)]
    words = "Their own pages, and all of a data set side by side, with tests and intervals."
    sections.append(Section("pages", "Every evaluation", words, links=addresses))
    words = "For every evaluation: queries and top predictions with their heaviest matches, and the histogram of "
    words += "shifts. An incorrect prediction has the correct image below it."
    sections.append(Section("predictions", "Predictions", words, gallery=_gallery(evaluations)))
    sections.append(Section("costs", "Seconds and sizes", tables=costs, images=speed))
    sections.append(Section("settings", "Data sets and settings", tables=about))
    words = f"{len(evaluations.datasets)} data sets, {len(evaluations.folders)} evaluations, "
    words += "after Pivonka and Preucil, IEEE T-IV 2024"
    write_page(out / PAGE, title="The paper's evaluation", words=words, facts={}, sections=sections)


def _by_sequence(evaluations: Evaluations) -> Iterator[Chart]:
    """Recall by sequence at the middle threshold, of data sets with several sequences."""
    for name, dataset in evaluations.datasets.items():
        thresholds, truth = evaluations.thresholds(name), dataset.sequences[0].truth
        if len(dataset.sequences) < 2 or truth is None or not thresholds:
            continue
        groups, within = {}, threshold_words(truth.unit, middle(thresholds))
        for row in evaluations.rows:
            if row.leads and (result := evaluations.results.get((row.name, name))):
                shares = {
                    part.name: result.recall[part.name][middle(thresholds)][1] / 100 for part in dataset.sequences
                }
                groups[row.title] = {part: Estimate(share, (share, share)) for part, share in shares.items()}
        if groups:
            title = f"{evaluations.title(name)}, by sequence{within}"
            yield bar_chart(f"sequences-{name}", title, groups, axis="recall at 1, %")


def _gallery(evaluations: Evaluations) -> Gallery:
    """Pictures of every evaluation, as many as there is room for; sequences are named with their data set."""
    each, shown = max(1, MOST_PICTURES // max(1, len(evaluations.folders))), []
    for (dataset, run), folder in evaluations.folders.items():
        for picture in pictures(folder, most=each):
            sequence = picture["sequence"]
            sequence = dataset if sequence in ("", dataset) else f"{dataset} {sequence}"
            shown.append(picture | {"system": f"{run}: {picture['system']}", "sequence": sequence})
    systems, sequences = (dict.fromkeys(picture[name] for picture in shown) for name in ("system", "sequence"))
    return Gallery("", [*systems], [*sequences], shown)
