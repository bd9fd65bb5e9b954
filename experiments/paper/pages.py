"""The figure of the evaluations at hand, the page of all of them, and one of each data set's side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from experiments.paper.tables import Evaluations, average, printed_tables
from mfvpr.report import Table
from mfvpr.report.figures import panels, save_figure
from mfvpr.report.pages import PAGE, embed, write_comparison, write_page
from mfvpr.utils.fingerprints import versions

_COSTS, _ABOUT = ("sizes", "seconds"), ("data_sets", "settings")  # names of tables
_MIDDLE = 1  # of the tolerances: the paper's figure
_OVER_PAPERS = "printed, over the paper's six"
_OURS, _PRINTED = "#2f6fb0", "#c9a227"


def mean_recalls(evaluations: Evaluations) -> dict[str, dict[str, float]]:
    """Mean recall at 1 within 2 frames by title, here (see `Evaluations.means`) and printed, as far as there are."""
    groups: dict[str, dict[str, float]] = {f"over {evaluations.averaged}": {}, _OVER_PAPERS: {}}
    for row in evaluations.rows:
        means = evaluations.means[1].get(row.name), average(printed_tables()["recall"].get(row.name, {}))
        for group, mean in zip(groups.values(), means, strict=True):
            if mean is not None:
                group[row.title] = float(mean[_MIDDLE])
    return {label: group for label, group in groups.items() if group}


def draw_averages(path: Path, evaluations: Evaluations) -> None:
    """Draw the means of `mean_recalls` side by side, if there are any."""
    groups = mean_recalls(evaluations)
    titles = [row.title for row in evaluations.rows if any(row.title in group for group in groups.values())]
    if not titles:
        return
    figure, [axes] = panels(1, 9, 1.2 + 0.3 * len(titles))
    for number, (label, members) in enumerate(groups.items()):
        places = [titles.index(title) + 0.4 * (number - (len(groups) - 1) / 2) for title in members]
        color = _PRINTED if label == _OVER_PAPERS else _OURS
        bars = axes.barh(places, [*members.values()], 0.38, label=label, color=color)
        axes.bar_label(bars, fmt="%.1f", padding=2, fontsize=7)
    axes.set_yticks(range(len(titles)), titles, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0, 108), xlabel="mean Recall@1 within 2 frames, %")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize=8)
    save_figure(figure, path)


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
        about["Left out"] = Table(["what", "why"], [line.split(": ", 1) for line in left_out], text_columns=2)
    figure = out / "figures" / "averages.png"
    averages = {"Mean recall at 1 within 2 frames": embed(figure.read_bytes())} if figure.exists() else {}
    words = "In %. Where the paper prints a number, that and the difference stand beside ours."
    links_words = "Their own pages, and all of a data set side by side, with tests and intervals."
    parts = {
        "Recall": {"words": words, "tables": recalls, "images": averages},
        "Every evaluation": {"words": links_words, "links": addresses},
        "Seconds and sizes": {"tables": costs},
        "Data sets and settings": {"tables": about | {"Versions": versions()}},
    }
    words = f"{len(evaluations.datasets)} data sets, {len(evaluations.folders)} evaluations, "
    words += "after Pivonka and Preucil, IEEE T-IV 2024"
    write_page(out / PAGE, title="The paper's evaluation", words=words, facts={}, parts=parts)
