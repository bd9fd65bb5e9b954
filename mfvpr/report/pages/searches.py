"""The page of a sweep, of a learning comparison, or of the jobs of a multirun."""

from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mfvpr.report.pages.files import errors_as_input_errors, read_table
from mfvpr.report.pages.rendering import Section, values_table, write_page

_TABLES = {"rows": "All scores", "axes": "All settings", "jobs": "All jobs"}  # by a name in results.json
_LONG = {"settings", "rows", "queries", "report", "jobs"}  # what the tables show


def write_search_page(folder: Path, results: Mapping[str, Any], path: Path) -> None:
    """Write the page of a run folder whose results are no evaluation's.

    Raises:
        InputError: the files are not those of a sweep, a learning comparison, or a multirun.
    """
    with errors_as_input_errors(folder):
        caption = next((caption for name, caption in _TABLES.items() if name in results), None)
        if caption is None:
            raise ValueError(f"results.json has no {', '.join(_TABLES)}")
        heading = (folder / "table.md").read_text("utf-8").splitlines()[0]
        summary = (folder / "summary.txt").read_text("utf-8") if (folder / "summary.txt").exists() else ""
        figures = {file.stem: f"data:image/png;base64,{b64encode(file.read_bytes()).decode()}"
                   for file in sorted((folder / "figures").glob("*.png"))}  # fmt: skip
        tables = {caption: read_table(folder / "table.csv", None)}
        about = values_table({name: value for name, value in results.items() if name not in _LONG})
    title, _, words = heading.partition(": ")
    sections = [
        Section("results", "Results", text=summary.removeprefix(heading).strip(), images=figures, tables=tables),
        Section("settings", "Settings and versions", tables={"Run": about}),
    ]
    write_page(path, title=title, words=words, facts={}, sections=sections)
