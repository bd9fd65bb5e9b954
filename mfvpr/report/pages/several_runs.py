"""The page that compares several runs by their headline systems."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mfvpr.evaluation.statistics import mcnemar, path_test
from mfvpr.report.pages import one_run
from mfvpr.report.pages.charts import bar_chart
from mfvpr.report.pages.files import Run, read_run
from mfvpr.report.pages.rendering import Section, flat, write_page
from mfvpr.report.run_files import Difference
from mfvpr.report.tables import Table, format_estimate
from mfvpr.utils.errors import InputError


def write_comparison(folders: Sequence[Path], path: Path) -> None:
    """Write a page of several runs side by side; InputError for a folder twice, or of no evaluation."""
    runs = dict(zip(_labels(folders), map(read_run, folders), strict=True))
    overview, facts = [], {}
    for label, run in runs.items():
        seconds = f"{sum(run.common['seconds'].values()):.1f}"
        overview.append([label, run.common["dataset"], run.headline, one_run.description(run), seconds])
        if run.gains:
            facts[f"{label}, R@1{run.within}"] = f"{100 * run.all_gains.recall(run.headline).recall:.1f} %"
    header = ["run", "data set", "decides", "what was evaluated", "seconds"]
    sections = [Section("runs", "Runs", tables={"Runs": Table(header, overview, 4)})]
    if facts:
        sections += [_recall({label: run for label, run in runs.items() if run.gains}), _pairs(runs)]
    words = "The systems that decide, beside each other; each run has a page of its own."
    title = f"{', '.join(dict.fromkeys(run.common['dataset'] for run in runs.values()))}: {len(runs)} runs compared"
    write_page(path, title=title, words=words, facts=facts, sections=[*sections, _settings(runs)])


def why_not(first: Run, second: Run) -> str | None:
    """The reason that two runs cannot be compared query by query; None = they can."""
    if not (first.gains and second.gains):
        return "a run has no ground truth"
    if first.common["data_fingerprint"] != second.common["data_fingerprint"]:
        return "other images"
    names, truths = ("kind", "files", "unit", "thresholds", "exclude_neighbors", "fingerprint"), []
    for run in (first, second):
        truths.append([run.common["ground_truth"].get(name) for name in names])
    if differ := [name for name, ours, theirs in zip(names, *truths, strict=True) if ours != theirs]:
        return f"another ground truth ({', '.join(differ)})"
    ours, theirs = first.all_gains, second.all_gains
    if ours.queries != theirs.queries or [*first.gains] != [*second.gains]:
        return "other queries"
    return None if np.array_equal(ours.places, theirs.places) else "another ground truth (its file has changed)"


def _labels(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths that differ."""
    paths = [folder.absolute().parts for folder in folders]
    for length in range(1, max(map(len, paths)) + 1):
        labels = ["/".join(parts[-length:]) for parts in paths]
        if len({*labels}) == len(labels):
            return labels
    twice = next(folder for folder in folders if paths.count(folder.absolute().parts) > 1)
    raise InputError(f"{twice}: expected different run folders, got this one twice")


def _recall(runs: Mapping[str, Run]) -> Section:
    """Recall of all systems side by side; of the headline systems with intervals and over K."""
    curves = {label: (run, run.headline) for label, run in runs.items()}
    headlines = {"recall": {label: run.all_gains.recall(run.headline) for label, run in runs.items()}}
    charts = [
        bar_chart("intervals", "Recall at 1, with intervals", headlines, axis="recall at 1, %"),
        one_run.depths_chart("Recall over K", curves),
        *one_run.tolerance_charts(curves),
        *one_run.precision_charts(curves),
    ]
    rows = []
    for system in dict.fromkeys(name for run in runs.values() for name in run.systems):
        cells = [""] * len(runs)
        for column, run in enumerate(runs.values()):
            if system in run.systems:
                cells[column] = format_estimate(run.all_gains.recall(system))
        rows.append([system, *cells])
    header = ["system", *(f"{label}{run.within}" for label, run in runs.items())]
    words = "In %, of all queries, correct at the middle tolerance of each run; intervals are 95 % and know that "
    words += "neighbors along the path fail together."
    if any(why_not(*pair) for pair in itertools.combinations(runs.values(), 2)):
        words += " Not all of these runs have the same queries and the same ground truth: see below."
    return Section("recall", "Recall", words, charts, {"Recall at 1 of every system": Table(header, rows)})


def _pairs(runs: Mapping[str, Run]) -> Section:
    """Tests of every two runs, query by query, and the pairs that cannot be compared."""
    rows, incomparable = [], []
    for (label, run), (other, second) in itertools.combinations(runs.items(), 2):
        if reason := why_not(run, second):
            incomparable.append([label, other, reason])
            continue
        pair = run.all_gains.hits(run.headline), second.all_gains.hits(second.headline)
        names = f"{label}: {run.headline}", f"{other}: {second.headline}"
        rows.append(Difference(*names, mcnemar(*pair), path_test(*pair)).cells)
    words, tests = one_run.paired_tests("run", rows)
    tables = {"Every two runs of the same queries": tests} if rows else {}
    if incomparable:
        tables["Not comparable query by query"] = Table(["run", "other", "why"], incomparable, 3)
    return Section("pairs", "Every two runs", words, tables=tables)


def _settings(runs: Mapping[str, Run]) -> Section:
    """Settings that differ, and settings that are alike."""
    settings = {}
    for label, run in runs.items():
        about = {name: run.about.get(name) for name in ("command", "commit", "settings", "ground_truth")}
        about |= {name: run.common[name] for name in ("data_fingerprint", "versions", "seconds")}
        settings[label] = dict(flat(about))
    names = dict.fromkeys(name for values in settings.values() for name in values)
    rows = [[name, *(values.get(name, "") for values in settings.values())] for name in names]
    tables = {
        "What differs": Table(["name", *settings], [row for row in rows if len({*row[1:]}) > 1], 1 + len(settings)),
        "What is alike": Table(["name", "value"], [row[:2] for row in rows if len({*row[1:]}) == 1], 2),
    }
    return Section("settings", "Settings and versions", tables=tables)
