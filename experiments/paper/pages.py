"""The pages: one of all evaluations, and one of each data set's evaluations side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from experiments.paper.figures import mean_recalls
from experiments.paper.tables import Evaluations
from experiments.paper.timing import STEPS
from mfvpr.datasets.truth import middle, threshold_words
from mfvpr.report import Table
from mfvpr.report.pages.charts import Bar, Chart, amount_chart, bar_chart, line_chart
from mfvpr.report.pages.one_run import PAGE, values_table
from mfvpr.report.pages.pictures import MOST_PICTURES, pictures
from mfvpr.report.pages.rendering import Gallery, Section, write_page
from mfvpr.report.pages.several_runs import write_comparison
from mfvpr.utils.versions import versions

_COSTS, _ABOUT = ("sizes", "seconds"), ("data_sets", "settings")  # names of tables


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
    sections = [
        Section("recall", "Recall", "In %. Where the paper prints a number, that and the difference stand beside ours.",
                [_averages(evaluations), *_by_sequence(evaluations)], recalls),
        Section("pages", "Every evaluation", "Their own pages, and all of a data set side by side, with tests and "
                "intervals.", links=addresses),
        Section("predictions", "Predictions", "For every evaluation: queries and top predictions with their heaviest "
                "matches, and the histogram of shifts. An incorrect prediction has the correct image below it.",
                gallery=_gallery(evaluations)),
        Section("costs", "Seconds and sizes", "", [*_costs(evaluations)], costs),
        Section("settings", "Data sets and settings", tables=about),
    ]  # fmt: skip
    words = f"{len(evaluations.datasets)} data sets, {len(evaluations.folders)} evaluations, "
    words += "after Pivonka and Preucil, IEEE T-IV 2024"
    write_page(out / PAGE, title="The paper's evaluation", words=words, facts={}, sections=sections)


def _averages(evaluations: Evaluations) -> Chart:
    groups = {label: {title: Bar(value) for title, value in members.items()}
              for label, members in mean_recalls(evaluations).items()}  # fmt: skip
    return bar_chart("averages", "Mean recall at 1 within 2 frames", groups, axis="mean recall at 1, %")


def _by_sequence(evaluations: Evaluations) -> Iterator[Chart]:
    """Recall by sequence at the middle threshold, of data sets with several sequences."""
    for name, dataset in evaluations.datasets.items():
        thresholds, truth = evaluations.thresholds(name), dataset.sequences[0].truth
        if len(dataset.sequences) < 2 or not thresholds:
            continue
        threshold = middle(thresholds)
        groups = {
            row.title: {part.name: Bar(result.recall[part.name][threshold][1]) for part in dataset.sequences}
            for row in evaluations.rows
            if row.leads and (result := evaluations.results.get((row.name, name)))
        }
        if groups:
            within = threshold_words(truth.unit, threshold) if truth else ""
            yield bar_chart(
                f"sequences-{name}", f"{evaluations.title(name)}, by sequence{within}", groups, axis="recall at 1, %"
            )


def _costs(evaluations: Evaluations) -> Iterator[Chart]:
    if evaluations.seconds:
        titles = {row.name: row.title for row in evaluations.rows}
        totals = {titles[name]: sum(steps[step] for step in STEPS) for name, steps in evaluations.seconds.items()}
        yield amount_chart("seconds", f"Seconds of a query of {evaluations.timed_on}", totals, axis="seconds")
    if evaluations.growth:
        curves = {title: [(float(size), value) for size, value in seconds.items()]
                  for title, seconds in evaluations.growth.items()}  # fmt: skip
        axes = "images of a database, whose descriptors are made up", "seconds of a query"
        yield line_chart("growth", "As a database grows", curves, axes=axes, scale="log", marked=True, unit="s")


def _gallery(evaluations: Evaluations) -> Gallery:
    """Pictures of every evaluation, as many as there is room for; sequences are named with their data set."""
    each = max(1, MOST_PICTURES // max(1, len(evaluations.folders)))
    shown = [
        replace(
            picture, system=f"{run}: {picture.system}",
            sequence=dataset if picture.sequence in ("", dataset) else f"{dataset} {picture.sequence}",
        )
        for (dataset, run), folder in evaluations.folders.items() for picture in pictures(folder, most=each)
    ]  # fmt: skip
    systems, sequences = (dict.fromkeys(getattr(picture, name) for picture in shown) for name in ("system", "sequence"))
    return Gallery("", [*systems], [*sequences], shown)
