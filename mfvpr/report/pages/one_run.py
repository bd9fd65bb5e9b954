"""The page of one run."""

from pathlib import Path

from mfvpr.report.pages import sections
from mfvpr.report.pages.files import Run, read_run
from mfvpr.report.pages.rendering import write_page
from mfvpr.reranking.results import FILTER

PAGE = "report.html"  # in a run folder
_NAMELESS = "folder"  # the default name of a data set of own folders


def write_report(folder: Path, path: Path | None = None) -> Path:
    """The page of a run folder, by default in it.

    Returns:
        where it is.

    Raises:
        InputError: it is no run folder of an evaluation.
    """
    run, path = read_run(folder), path or folder / PAGE
    judged = [sections.recall_section(run), sections.differences_section(run)] if run.gains else []
    parts = [*judged, sections.confidence_section(run), sections.answers_section(run), sections.costs_section(run),
             sections.settings_section(run)]  # fmt: skip
    write_page(path, title=_title(run), words=in_words(run), facts=_facts(run),
               sections=[part for part in parts if part is not None])  # fmt: skip
    return path


def _title(run: Run) -> str:
    """The name of the data set; of folders without a name of their own, the ends of their paths."""
    name, dataset = run.common["dataset"], run.about["settings"].get("dataset")
    sides = [dataset.get(side) for side in ("queries", "database")] if isinstance(dataset, dict) else [None]
    if name != _NAMELESS or not all(isinstance(side, str) for side in sides):
        return name
    return " in ".join("/".join(Path(str(side)).parts[-2:]) for side in sides)


def in_words(run: Run) -> str:
    """One line that says what was evaluated."""
    common = run.common
    several = f" in {len(run.sequences)} sequences" if len(run.sequences) > 1 else ""
    right = f"right is what is within{run.within}" if run.gains and run.within else ""
    right = right or ("right or not, as told" if run.gains else "no ground truth: rankings only")
    lacks = f"; incomplete: {', '.join(common['incomplete'])}" if common.get("incomplete") else ""
    return (
        f"{common['queries']} queries{several}, {common['database']} database images, {common['candidates']} candidates"
        f" ({common['filter']['name']}), {common['features']['name']} features; {right}{lacks}"
    )


def _facts(run: Run) -> dict[str, str]:
    facts = {"decides": run.headline}
    for name in dict.fromkeys((run.headline, FILTER)) if run.gains else ():
        hits, interval = run.all_gains.hits(name), sections.interval(run.all_gains, name)
        found = f"{100 * hits.mean():.1f} %", sections.percent(interval)
        facts[f"{name}, R@1{run.within}"] = " ".join(words.replace(" ", "\N{NO-BREAK SPACE}") for words in found)
    return facts | {"seconds in all": f"{sum(run.common['seconds'].values()):.1f}"}
