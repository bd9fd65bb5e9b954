"""The page that compares several runs, by the systems that decide in them."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.evaluation.statistics import block_sign_flips, mcnemar
from mfvpr.report.pages.charts import Bar, Chart, bars, lines
from mfvpr.report.pages.files import Run, read_run
from mfvpr.report.pages.one_run import in_words
from mfvpr.report.pages.rendering import write_page
from mfvpr.report.pages.sections import (
    PRECISION_AXES,
    Section,
    Sheet,
    flat,
    interval,
    percent,
    precision_by_recall,
    recall_by_depth,
    recall_by_tolerance,
)
from mfvpr.report.tables import Table
from mfvpr.utils.errors import InputError

_ONLY = ("run", "other", "only run", "only other", "McNemar p", "queries in a block", "blocks", "p by blocks")


def write_comparison(folders: Sequence[Path], path: Path) -> None:
    """A page of several runs beside each other.

    Raises:
        InputError: a folder is named twice, or is no run folder of an evaluation.
    """
    runs = dict(zip(_labels(folders), map(read_run, folders), strict=True))
    judged = {label: run for label, run in runs.items() if run.gains}
    parts = [_overview(runs), *([_recall(judged), _pairs(runs)] if judged else []), _settings(runs)]
    words = "The systems that decide, beside each other; each run has a page of its own."
    names = ", ".join(dict.fromkeys(str(run.common["dataset"]) for run in runs.values()))
    write_page(path, title=f"{names}: {len(runs)} runs compared", words=words, facts=_facts(judged), sections=parts)


def why_not(first: Run, second: Run) -> str | None:
    """Why two runs cannot be compared query by query; None = they can."""
    if not (first.gains and second.gains):
        return "a run has no ground truth"
    if first.common["data_fingerprint"] != second.common["data_fingerprint"]:
        return "other images"
    differ = [name for name in ("kind", "files", "unit", "thresholds", "exclude_neighbors",
                                                  "fingerprint")
              if first.common["ground_truth"].get(name) != second.common["ground_truth"].get(name)]  # fmt: skip
    if differ:
        return f"another ground truth ({', '.join(differ)})"
    ours, theirs = first.all_gains, second.all_gains
    if ours.queries != theirs.queries or [*first.gains] != [*second.gains]:
        return "other queries"
    return None if np.array_equal(ours.places, theirs.places) else "another ground truth (its file has changed)"


def _labels(folders: Sequence[Path]) -> list[str]:
    """The ends of their paths, as long as they need to be to differ."""
    paths = [folder.absolute().parts for folder in folders]
    for length in range(1, max(map(len, paths)) + 1):
        labels = ["/".join(parts[-length:]) for parts in paths]
        if len({*labels}) == len(labels):
            return labels
    twice = next(folder for row, folder in enumerate(folders) if folder.absolute() in map(Path.absolute, folders[:row]))
    raise InputError(f"{twice}: expected different run folders, got this one twice")


def _facts(runs: Mapping[str, Run]) -> dict[str, str]:
    return {f"{label}, R@1{run.within}": f"{_percent(run):.1f} %" for label, run in runs.items()}


def _percent(run: Run) -> float:
    return 100 * float(run.all_gains.hits(run.headline).mean())


def _overview(runs: Mapping[str, Run]) -> Section:
    rows = [
        [label, str(run.common["dataset"]), run.headline, in_words(run), f"{sum(run.common['seconds'].values()):.1f}"]
        for label, run in runs.items()
    ]
    header = ["run", "data set", "decides", "what was evaluated", "seconds"]
    return Section("runs", "Runs", sheets=[Sheet("Runs", Table(header, rows, 4))])


def _recall(runs: Mapping[str, Run]) -> Section:
    """Of all systems side by side, and of those that decide with intervals and over K."""
    bar = {label: Bar(_percent(run), interval(run.all_gains, run.headline)) for label, run in runs.items()}
    curves = {
        label: recall_by_depth(run.all_gains, run.headline, run.common["candidates"]) for label, run in runs.items()
    }
    charts = [
        bars("intervals", "Recall at 1, with intervals", {"recall": bar}, axis="recall at 1, %"),
        lines("depths", "Recall over K", curves, axes=("K, the first candidates", "recall at K, %"), scale="log"),
        *_over_tolerance(runs),
    ]
    if precision := {
        name: curve for label, run in runs.items()
        for name, curve in precision_by_recall(run, {run.headline: label}).items()
    }:  # fmt: skip
        title = "Precision and recall by the score"
        charts.append(lines("precision", title, precision, axes=PRECISION_AXES, scale="percent"))
    systems = list(dict.fromkeys(name for run in runs.values() for name in run.systems))
    rows = [
        [system, *(_with_interval(run, system) if system in run.systems else "" for run in runs.values())]
        for system in systems
    ]
    header = ["system", *(f"{label}{run.within}" for label, run in runs.items())]
    words = "In %, of all queries, right at the middle tolerance of each run; intervals are 95 % and know that "
    words += "neighbors along the path fail together."
    if any(why_not(*pair) for pair in itertools.combinations(runs.values(), 2)):
        words += " Not all of these runs have the same queries and the same ground truth: see below."
    return Section("recall", "Recall", words, charts, [Sheet("Recall at 1 of every system", Table(header, rows))])


def _over_tolerance(runs: Mapping[str, Run]) -> list[Chart]:
    """Of those that are judged by several thresholds of one unit, at one depth."""
    several = {label: run for label, run in runs.items() if len(run.thresholds) > 1}
    charts = []
    for kind in dict.fromkeys((run.unit, run.first_k) for run in several.values()):
        own = {label: run for label, run in several.items() if (run.unit, run.first_k) == kind}
        curves = {label: recall_by_tolerance(run)[run.headline] for label, run in own.items()}
        axes = f"tolerance, {kind[0]}", f"recall at {kind[1]}, %"
        name = f"tolerances-{len(charts)}"
        charts.append(lines(name, "Recall over tolerance", curves, axes=axes, marked=True))
    return charts


def _with_interval(run: Run, system: str) -> str:
    low_high = interval(run.all_gains, system)
    return f"{100 * run.all_gains.hits(system).mean():.1f} {percent(low_high)}"


def _pairs(runs: Mapping[str, Run]) -> Section:
    """Every two runs, query by query, and which cannot be compared so."""
    rows, apart = [], []
    for (label, run), (other, second) in itertools.combinations(runs.items(), 2):
        if reason := why_not(run, second):
            apart.append([label, other, reason])
            continue
        pair = run.all_gains.hits(run.headline), second.all_gains.hits(second.headline)
        test, flips = mcnemar(*pair), block_sign_flips(*pair, places=np.sort(run.all_gains.places))
        rows.append([f"{label}: {run.headline}", f"{other}: {second.headline}", str(test.only_first),
                     str(test.only_second), f"{test.p_value:.2g}", str(flips.block), str(flips.blocks),
                     f"{flips.p_value:.2g}"])  # fmt: skip
    words = "How many queries only one of two runs gets right, and how probable that is if neither is better: by "
    words += "McNemar's exact test, which takes queries for independent, and by blocks of neighbors along the path."
    sheets = [Sheet("Every two runs of the same queries", Table(_ONLY, rows, 2))] if rows else []
    sheets += [Sheet("Not comparable query by query", Table(["run", "other", "why"], apart, 3))] if apart else []
    return Section("pairs", "Every two runs", words, sheets=sheets)


def _settings(runs: Mapping[str, Run]) -> Section:
    """What differs, and what is alike."""
    named = {label: dict(flat(_made_by(run))) for label, run in runs.items()}
    names = list(dict.fromkeys(name for values in named.values() for name in values))
    rows = [[name, *(values.get(name, "") for values in named.values())] for name in names]
    header, width = ["name", *named], 1 + len(named)
    differ = [row for row in rows if len({*row[1:]}) > 1]
    alike = [row[:2] for row in rows if len({*row[1:]}) == 1]
    sheets = [Sheet("What differs", Table(header, differ, width)),
              Sheet("What is alike", Table(["name", "value"], alike, 2))]  # fmt: skip
    return Section("settings", "Settings and versions", sheets=sheets)


def _made_by(run: Run) -> dict[str, Any]:
    about = {name: run.about.get(name) for name in ("command", "commit", "settings", "ground_truth")}
    return about | {name: run.common[name] for name in ("data_fingerprint", "versions", "seconds")}
