"""The pages: of all evaluations, with the way to those of each, and of every data set's side by side."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from experiments.paper.figures import mean_bars
from experiments.paper.tables import Found, listed, thresholds_of
from experiments.paper.timing import STEPS
from mfvpr.datasets.truth import middle, threshold_words
from mfvpr.report import Table
from mfvpr.report.pages.charts import Bar, Chart, amounts, bars, lines
from mfvpr.report.pages.one_run import PAGE
from mfvpr.report.pages.pictures import MOST_PICTURES, Picture, pictures
from mfvpr.report.pages.rendering import write_page
from mfvpr.report.pages.sections import Gallery, Section, Sheet, flat
from mfvpr.report.pages.several_runs import write_comparison
from mfvpr.utils.versions import versions

Tables = Mapping[str, tuple[str, Table]]  # heading and table by name
_COSTS, _ABOUT = ("sizes", "seconds"), ("data_sets", "settings")


def write(
    out: Path,
    found: Found,
    tables: Tables,
    growth: Mapping[str, Mapping[int, float]],
    runs: Mapping[tuple[str, str], Path],
    left_out: Sequence[str],
) -> None:
    """`report.html` of all, and in `comparisons/` a page of each data set's evaluations side by side.

    Args:
        out: folder of them.
        found: what was evaluated.
        tables: of it.
        growth: seconds of a query by title and by the size of the database.
        runs: folders of the evaluations, by data set and name.
        left_out: lines that say what was not evaluated, and what that needs.
    """
    comparisons = {}
    for name in found.datasets:
        folders = [folder for (dataset, _), folder in runs.items() if dataset == name]
        if len(folders) > 1:
            comparisons[name] = out / "comparisons" / f"{name}.html"
            write_comparison(folders, comparisons[name])
    parts = [
        Section("recall", "Recall", "In %. Where the paper prints a number, that and the difference stand beside ours.",
                [_averages(found), *_by_sequence(found)],
                _sheets(tables, [name for name in tables if name not in (*_COSTS, *_ABOUT)])),
        Section("pages", "Every evaluation", "Their own pages, and all of a data set side by side, with tests and "
                "intervals.", links=[*_links(out, runs, comparisons)]),
        Section("answers", "Answers", "Of each evaluation: query and first answer with their heaviest matches, and the "
                "histogram of their shifts; below a wrong answer the right one.", gallery=_gallery(runs)),
        Section("costs", "Seconds and sizes", "", [*_costs(found, growth)], _sheets(tables, _COSTS)),
        Section("settings", "Data sets and settings", "", sheets=[*_sheets(tables, _ABOUT), *_left_out(left_out),
                                                                  _versions()]),
    ]  # fmt: skip
    words = f"{len(found.datasets)} data sets, {len(runs)} evaluations, after Pivonka and Preucil, IEEE T-IV 2024"
    write_page(out / PAGE, title="The paper's evaluation", words=words, facts={}, sections=parts)


def _averages(found: Found) -> Chart:
    """Ours and the printed ones."""
    all_bars = mean_bars(found)
    sides = {f"over {listed(found)}": 1, "printed, over the paper's six": 2}
    groups = {
        words: {bar[0]: Bar(float(value)) for bar in all_bars if (value := bar[place]) is not None}
        for words, place in sides.items()
    }
    shown = {words: members for words, members in groups.items() if members}
    return bars("averages", "Mean recall at 1 within 2 frames", shown, axis="mean recall at 1, %")


def _by_sequence(found: Found) -> Iterator[Chart]:
    """Of data sets with several sequences, at the middle threshold."""
    for name, dataset in found.datasets.items():
        thresholds = thresholds_of(found, name)
        if len(dataset.sequences) < 2 or not thresholds:
            continue
        groups: dict[str, dict[str, Bar]] = {}
        threshold = middle(thresholds)
        for row in found.rows:
            if row.leads and (one := found.evaluated.get((row.name, name))):
                groups[row.title] = {part.name: Bar(one.recall[part.name][threshold][1]) for part in dataset.sequences}
        if groups:
            within = threshold_words(dataset.sequences[0].truth.unit, threshold) if dataset.sequences[0].truth else ""
            yield bars(f"sequences-{name}", f"{found.title(name)}, by sequence{within}", groups, axis="recall at 1, %")


def _costs(found: Found, growth: Mapping[str, Mapping[int, float]]) -> Iterator[Chart]:
    if found.seconds:
        titles = {row.name: row.title for row in found.rows}
        totals = {titles[name]: sum(one[step] for step in STEPS) for name, one in found.seconds.items()}
        yield amounts("seconds", f"Seconds of a query of {found.timed_on}", totals, axis="seconds")
    if growth:
        curves = {title: [(float(size), value) for size, value in by.items()] for title, by in growth.items()}
        axes = "images of a database, whose descriptors are made up", "seconds of a query"
        yield lines("growth", "As a database grows", curves, axes=axes, scale="log", marked=True, unit="s")


def _sheets(tables: Tables, names: Sequence[str]) -> list[Sheet]:
    return [Sheet(*tables[name]) for name in names if name in tables]


def _versions() -> Sheet:
    return Sheet("Versions", Table(["name", "value"], [*map(list, flat(versions()))], text_columns=2))


def _left_out(lines: Sequence[str]) -> list[Sheet]:
    rows = [[*line.partition(": ")[::2]] for line in lines]
    return [Sheet("Left out", Table(["what", "why"], rows, text_columns=2))] if rows else []


def _links(
    out: Path, runs: Mapping[tuple[str, str], Path], comparisons: Mapping[str, Path]
) -> Iterator[tuple[str, str]]:
    """Words, and addresses from a page in the folder of all."""
    for dataset in dict.fromkeys(name for name, _ in runs):
        shown = {f"{dataset}: all side by side": comparisons[dataset]} if dataset in comparisons else {}
        shown |= {f"{dataset}: {run}": folder / PAGE for (name, run), folder in runs.items() if name == dataset}
        for words, path in shown.items():
            if path.is_file():
                yield words, quote(path.relative_to(out).as_posix())


def _gallery(runs: Mapping[tuple[str, str], Path]) -> Gallery:
    """Of every evaluation as many as there is room for; the data set is part of the sequence's name."""
    each = max(1, MOST_PICTURES // max(1, len(runs)))
    shown = [
        _named(one, dataset, run) for (dataset, run), folder in runs.items() for one in pictures(folder, most=each)
    ]
    systems, sequences = (list(dict.fromkeys(getattr(one, name) for one in shown)) for name in ("system", "sequence"))
    return Gallery("", systems, sequences, shown, [], 0)


def _named(picture: Picture, dataset: str, run: str) -> Picture:
    sequence = dataset if picture.sequence in ("", dataset) else f"{dataset} {picture.sequence}"
    return replace(picture, system=f"{run}: {picture.system}", sequence=sequence)
