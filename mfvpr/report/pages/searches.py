"""The page of a sweep, of a learning comparison, or of the jobs of a multirun."""

import os
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.datasets.truth import middle, threshold_words
from mfvpr.report.pages.charts import Bar, Chart, bar_chart
from mfvpr.report.pages.files import errors_as_input_errors, read_table
from mfvpr.report.pages.rendering import PAGE, Section, values_table, write_page
from mfvpr.report.tables import format_value

_SHOWN = {"settings", "rows", "queries", "report", "jobs"}  # elsewhere than among the settings


def write_search_page(folder: Path, results: Mapping[str, Any], path: Path) -> None:
    """Write the page of a run folder with the results of several settings.

    Raises:
        InputError: the files are not those of a sweep, a learning comparison, or a multirun.
    """
    with errors_as_input_errors(folder):
        if not {"axes", "rows", "jobs"} & {*results}:
            raise ValueError("results.json has neither axes nor rows nor jobs")
        title, _, words = (folder / "table.md").read_text("utf-8").splitlines()[0].partition(": ")
        facts, charts = {}, []
        if "axes" in results:
            names = ["chosen"] if len(results["chosen"]) == 1 else ["chosen by the first half", "by the second half"]
            facts = dict(zip(names, map(_in_words, results["chosen"]), strict=True))
            charts = [_verdicts(results)]
        elif "rows" in results:
            charts = [_scores(results)]
        pages = [(job["run"], os.path.relpath(page, path.parent)) for job in results.get("jobs", [])
                 if (page := Path(job["run"]) / PAGE).exists()]  # fmt: skip
        figures = {file.stem.replace("_", " "): f"data:image/png;base64,{b64encode(file.read_bytes()).decode()}"
                   for file in sorted((folder / "figures").glob("*.png"))}  # fmt: skip
        tables = {"All results": read_table(folder / "table.csv", None)}
        settings = values_table({name: value for name, value in results.items() if name not in _SHOWN})
    sections = [Section("results", "Results", charts=charts, tables=tables, links=pages, images=figures)]
    sections += [Section("settings", "Settings and versions", tables={"Run": settings})]
    write_page(path, title=title, words=words, facts=facts, sections=sections)


def _in_words(setting: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {format_value(value)}" for name, value in setting.items())


def _verdicts(results: Mapping[str, Any]) -> Chart:
    """Recall of the chosen setting and of the scorer's own values at every threshold."""
    groups = {
        name: {f"R@1{threshold_words(results['unit'], verdict['threshold'])}": _bar(**verdict[key])
               for verdict in results["report"]}
        for name, key in (("own values", "own"), ("chosen", "chosen"))
    }  # fmt: skip
    return bar_chart("recall", "Recall at 1, with intervals", groups, axis="recall at 1, %")


def _scores(results: Mapping[str, Any]) -> Chart:
    """Recall of all scores of a learning comparison at the threshold that decides."""
    threshold = middle(results["thresholds"])
    bars = {row["score"]: _bar(row["recall_at_1"][f"{threshold:g}"], row["interval"][f"{threshold:g}"])
            for row in results["rows"]}  # fmt: skip
    title = f"Recall at 1{threshold_words(results['unit'], threshold)}, with intervals"
    return bar_chart("recall", title, {"recall": bars}, axis="recall at 1, %")


def _bar(recall: float, interval: tuple[float, float]) -> Bar:
    low, high = interval
    return Bar(100 * recall, (100 * low, 100 * high))
