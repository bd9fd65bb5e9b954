"""The page of one run: an evaluation, a sweep, a learning comparison, or the jobs of a multirun."""

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.datasets.datasets import MEANS
from mfvpr.evaluation.confidence import PrecisionRecall
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.report.pages.charts import Chart, amount_chart, bar_chart, line_chart
from mfvpr.report.pages.files import Run, read_results, read_run, reading_run
from mfvpr.report.pages.rendering import PAGE, Gallery, Section, embed, pictures, values_table, write_page
from mfvpr.report.run_files import matched_content
from mfvpr.report.tables import Table, format_interval, read_table

MOST_PREDICTIONS = 5000  # rows of a table that a browser still sorts at once
_NAMELESS = "folder"  # the default name of a data set of own folders
_CURVE_POINTS = 200
_SIZES = {
    "queries": "queries",
    "database": "database images",
    "candidates": "candidates of a query",
}
_SEARCH_TABLES = {"rows": "All scores", "axes": "All settings", "jobs": "All jobs"}  # by a name in results.json
_IN_TABLES = {"settings", "rows", "queries", "report", "jobs"}  # names in results.json

Curves = Mapping[str, tuple[Run, str]]  # a run and one of its systems, by the name of their curve


def write_report(folder: Path, path: Path | None = None) -> Path:
    """Write the page of a run folder, by default into it, and return its path; InputError for other folders."""
    path, results = path or folder / PAGE, read_results(folder)
    if isinstance(results, dict):
        _write_search_page(folder, results, path)
        return path
    run = read_run(folder)
    common, tables, sections = run.common, run.tables, [_recall_section(run)] if run.gains else []
    if run.gains and tables["differences"].rows:
        words, tests = paired_tests("system", tables["differences"].rows)
        sections.append(Section("differences", "Differences", words, tables={"Every two systems": tests}))
    if "changes" in tables and tables["changes"].rows:
        verdicts = {"1": "correct", "0": "incorrect", "": ""}
        rows = [[*cells[:4], verdicts[cells[4]], cells[5], verdicts[cells[6]]] for cells in tables["changes"].rows]
        columns = ["system", "sequence", "query", "alone", "", "with the other queries", ""]
        changed = {"Changed predictions": Table(columns, rows, len(columns))}
        words = "First predictions that the other queries of a drive change."
        sections.append(Section("sequence", "Sequences", words, tables=changed))
    if run.gains:
        sections.append(_confidence_section(run))
    sections += [_predictions_section(run), _costs_section(run)]
    about = {name: run.about.get(name) for name in ("command", "commit")}
    about |= {name.replace("_", " "): common[name] for name in ("ground_truth", "data_fingerprint")}
    settings = {
        "Run": values_table(about),
        "Settings": values_table(run.about["settings"]),
        "Versions": values_table(common["versions"]),
        "Systems": values_table({row["system"]: row["parameters"] for row in run.results}),
    }
    if skipped := tables.get("skipped"):
        settings["Images that could not be used"] = Table(skipped.header, skipped.rows, 3)
    sections.append(Section("settings", "Settings and versions", tables=settings))
    title, dataset = common["dataset"], run.about["settings"]["dataset"]
    if title == _NAMELESS and isinstance(dataset.get("queries"), str):  # the ends of the paths of its folders
        title = " in ".join("/".join(Path(dataset[side]).parts[-2:]) for side in ("queries", "database"))
    facts = {"decides": run.headline}
    for name in dict.fromkeys((run.headline, RETRIEVAL)) if run.gains else ():
        recall, interval = run.all_gains.recall(name)
        words = f"{100 * recall:.1f}\N{NO-BREAK SPACE}%", format_interval(interval).replace(" ", "\N{NO-BREAK SPACE}")
        facts[f"{name}, R@1{run.within}"] = " ".join(words)
    facts["seconds in all"] = f"{sum(common['seconds'].values()):.1f}"
    write_page(path, title=title, words=description(run), facts=facts, sections=sections)
    return path


def _write_search_page(folder: Path, results: Mapping[str, Any], path: Path) -> None:
    """Write the page of a sweep, of a learning comparison, or of the jobs of a multirun."""
    with reading_run(folder):
        caption = next((caption for name, caption in _SEARCH_TABLES.items() if name in results), None)
        if caption is None:
            raise ValueError(f"results.json has no {', '.join(_SEARCH_TABLES)}")
        heading = (folder / "table.md").read_text("utf-8").splitlines()[0]
        summary = (folder / "summary.txt").read_text("utf-8") if (folder / "summary.txt").exists() else ""
        figures = {file.stem: embed(file) for file in sorted((folder / "figures").glob("*.png"))}
        tables = {caption: read_table(folder / "table.csv")}
        about = values_table({name: value for name, value in results.items() if name not in _IN_TABLES})
    title, _, words = heading.partition(": ")
    text = summary.removeprefix(heading).strip()
    sections = [
        Section("results", "Results", text=text, images=figures, tables=tables),
        Section("settings", "Settings and versions", tables={"Run": about}),
    ]
    write_page(path, title=title, words=words, facts={}, sections=sections)


def description(run: Run) -> str:
    """One line that says what was evaluated."""
    common = run.common
    several = f" in {len(run.sequences)} sequences" if len(run.sequences) > 1 else ""
    correct = "no ground truth: rankings only"
    if run.gains:
        correct = f"correct within{run.within}" if run.within else "correct by the ground truth"
    lacks = f"; incomplete: {', '.join(common['incomplete'])}" if common.get("incomplete") else ""
    return (
        f"{common['queries']} queries{several}, {common['database']} database images, {common['candidates']} candidates"
        f" ({common['retrieval']['name']}), {matched_content(common)}; {correct}{lacks}"
    )


def _recall_section(run: Run) -> Section:
    several, curves = len(run.gains) > 1, {name: (run, name) for name in run.systems}
    parts = {**run.gains, MEANS[-1]: run.all_gains} if several else {"": run.all_gains}
    recalls = {system: {name: gains.recall(system) for name, gains in parts.items()} for system in run.systems}
    groups = recalls if several else {"recall": {system: parts[""] for system, parts in recalls.items()}}
    intervals = bar_chart("intervals", f"Recall at 1{run.within}, with intervals", groups, axis="recall at 1, %")
    charts = [intervals, *tolerance_charts(curves), depths_chart(f"Recall over K{run.within}", curves)]
    words = f"In %. Results of single queries are those at the middle tolerance{run.within}. Intervals "
    words += "are 95 % and know that neighbors along the path fail together."
    table, rows = run.tables["table"], []
    for row in table.rows:
        recall = recalls[row[0]].get(row[1] if several else "")  # the plain mean of sequences has none
        rows.append([*row, format_interval(recall.interval) if recall else ""])
    shown = Table([*table.header, f"R@1{run.within}, 95 %"], rows, 1 + several)
    return Section("recall", "Recall", words, charts, {"Recall of every system": shown})


def depths_chart(title: str, curves: Curves) -> Chart:
    """Recall at K from 1 to all candidates, at all small Ks and some larger ones."""
    points = {}
    for name, (run, system) in curves.items():
        largest = max(run.common["candidates"], 1)
        depths = np.unique(np.geomspace(1, largest, _CURVE_POINTS).round().astype(int)).tolist()
        points[name] = [(k, 100 * float(run.all_gains.hits(system, k).mean())) for k in depths]
    return line_chart("depths", title, points, axes=("K, the first candidates", "recall at K, %"), scale="log")


def tolerance_charts(curves: Curves) -> list[Chart]:
    """Recall of all queries over the threshold, a chart for each unit and depth of runs with several thresholds."""
    by_kind: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
    for name, (run, system) in curves.items():
        if len(run.thresholds) > 1:
            unit, k = run.common["ground_truth"]["unit"], min(run.common["recall_at"], key=int)
            by_kind.setdefault((unit, k), {})[name] = [
                (row["tolerance"] if "tolerance" in row else row["radius"], 100 * row["recall_at"][k])
                for row in run.results
                if row["system"] == system and row.get("sequence", MEANS[-1]) == MEANS[-1]
            ]
    charts = []
    for number, ((unit, k), points) in enumerate(by_kind.items()):
        axes, name = (f"tolerance, {unit}", f"recall at {k}, %"), f"tolerances-{number}" if number else "tolerances"
        charts.append(line_chart(name, "Recall over tolerance", points, axes=axes, marked=True))
    return charts


def precision_charts(curves: Curves, by: str = "score", words: str = "by the score") -> list[Chart]:
    """Precision against recall, if the runs have them; names of curves have their average precision."""
    points = {}
    for name, (run, system) in curves.items():
        table = run.tables.get("precision_recall")
        rows = [[float(cell) for cell in row[2:]] for row in (table.rows if table else ()) if row[:2] == [system, by]]
        if rows:
            curve = PrecisionRecall(*np.array(rows).T)
            shown = np.unique(np.linspace(0, len(rows) - 1, _CURVE_POINTS).round().astype(int))
            label = f"{name}: AP {100 * curve.average_precision:.1f}"
            pairs = zip(curve.recall[shown], curve.precision[shown], strict=True)
            points[label] = [(round(100 * x, 3), round(100 * y, 3)) for x, y in pairs]
    axes = "recall of queries with a correct image, %", "precision, %"
    title = f"Precision and recall {words}"
    return [line_chart(f"precision-{by}", title, points, axes=axes, scale="percent")] if points else []


def paired_tests(kind: str, lines: Sequence[Sequence[str]]) -> tuple[str, Table]:
    """Explanation and table of paired tests of systems or of runs (`kind`), of lines as in `differences.csv`."""
    words = (
        f"How many queries only one of two {kind}s predicts correctly, and how probable that is if neither is better, "
        "by McNemar's exact test, which takes queries for independent, and by a test along the path."
    )
    rows = [[*line[:4], *(f"{float(cell):.2g}" for cell in line[4:])] for line in lines]
    columns = kind, "other", f"only {kind}", "only other", "McNemar p", "queries worth one", "p along the path"
    return words, Table(columns, rows, text_columns=2)


def _confidence_section(run: Run) -> Section:
    """Precision against recall, and recall over the share that is re-ranked; with ground truth."""
    table, shares, curves = (
        run.tables["confidence"],
        run.tables["rerank_share"],
        {name: (run, name) for name in run.systems},
    )
    charts = precision_charts(curves) + precision_charts(curves, "confidence", "by confidence")
    if shares.rows and len(shares.header) > 1:
        share, *recalls = [list(map(float, column)) for column in zip(*shares.rows, strict=True)]
        points = {RETRIEVAL: [(0.0, recalls[0][0]), (100.0, recalls[0][0])]}  # alone, it re-ranks nothing
        for name, recall in zip(shares.header[1:], recalls, strict=True):
            points[name] = [(100 * x, y) for x, y in zip(share, recall, strict=True)]
        axes, title = ("queries re-ranked, %", "recall at 1, %"), "Re-ranking only what retrieval is unsure of"
        charts.append(line_chart("shares", title, points, axes=axes, scale="percent"))
    tables = {"Confidence of top predictions, in %": table} if table.rows else {}
    words = "AP is the average precision, R@100P the recall at 100 % precision, ECE the expected calibration error of "
    return Section("confidence", "Precision and recall", f"{words}confidence.", charts, tables)


def _costs_section(run: Run) -> Section:
    seconds, common = run.common["seconds"], run.common
    rows = [[stage, f"{value:.3f}", f"{value / max(common['queries'], 1):.4f}"] for stage, value in seconds.items()]
    sizes = [[words, f"{common[name]}"] for name, words in _SIZES.items()]
    chart = amount_chart("seconds", "Seconds by stage", seconds, axis="seconds")
    tables = {"Seconds": Table(["stage", "seconds", "per query"], rows), "Sizes": Table(["what", "number"], sizes)}
    words = "What was in the stores already was not computed again."
    return Section("costs", "Seconds and sizes", words, [chart], tables)


def _predictions_section(run: Run) -> Section:
    """First predictions, with pictures of some."""
    total = len(run.systems) * len(run.all_gains.queries) if run.gains else 0
    predictions = [*islice(run.predictions(), MOST_PREDICTIONS)]
    left_out = max(0, total - len(predictions))
    gallery = Gallery(run.headline, run.systems, run.sequences, pictures(run.folder), predictions, left_out)
    words = "Query and top prediction with their heaviest matches, and the histogram of their shifts. An incorrect "
    words += "prediction has the correct image below it. The table has the queries without a picture, too."
    return Section("predictions", "Predictions", words, gallery=gallery)
