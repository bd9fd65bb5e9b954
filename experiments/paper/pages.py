"""The page of all evaluations at hand, and one of each data set's side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from experiments.paper.systems import LeftOut
from experiments.paper.tables import Evaluations
from mfvpr.report import Table
from mfvpr.report.pages import PAGE, write_comparison, write_page
from mfvpr.utils.fingerprints import versions


def write_pages(
    out: Path, evaluations: Evaluations, tables: Mapping[str, tuple[str, Table]], left_out: Sequence[LeftOut]
) -> None:
    """Write `report.html` of all evaluations, and in `comparisons/` a page of each data set's evaluations side by side.

    `tables` are (heading, table) by name.
    """
    links: list[tuple[str, Path]] = []
    for dataset in evaluations.datasets:
        folders = {run: folder for (name, run), folder in evaluations.folders.items() if name == dataset}
        if len(folders) > 1:
            links.append((f"{dataset}: all side by side", out / "comparisons" / f"{dataset}.html"))
            write_comparison([*folders.values()], links[-1][1])
        links += [(f"{dataset}: {run}", folder / PAGE) for run, folder in folders.items()]
    addresses = [(words, quote(path.relative_to(out).as_posix())) for words, path in links if path.is_file()]

    about: dict[str, Any] = {"Left out": Table(["name", "reason"], left_out, text_columns=2)} if left_out else {}
    about["Versions"] = versions()
    costs = dict(tables[name] for name in ("sizes", "seconds") if name in tables)
    recalls = dict(table for name, table in tables.items() if name not in ("data_sets", "sizes", "seconds"))
    words = "In %. Where the paper prints a number, that and the difference stand beside ours."
    links_words = "Their own pages with their settings, and all of a data set side by side, with tests and intervals."
    parts = {
        "Recall": {"words": words, "tables": recalls},
        "Every evaluation": {"words": links_words, "links": addresses},
        "Seconds and sizes": {"tables": costs},
        "Data sets": {"tables": dict([tables["data_sets"]]) | about},
    }
    words = f"{len(evaluations.datasets)} data sets, {len(evaluations.folders)} evaluations, "
    words += "after Pivonka and Preucil, IEEE T-IV 2024"
    write_page(out / PAGE, title="The paper's evaluation", words=words, facts={}, parts=parts)
