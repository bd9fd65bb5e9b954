"""The paper's evaluation as a program: every system on every data set at hand, then tables and figures."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments import build, truth
from experiments.console import tell
from experiments.errors import how_to_install
from experiments.paper import runs, systems, timing
from experiments.paper.figures import paper_figures
from experiments.paper.pages import write_pages
from experiments.paper.systems import Place, Row
from experiments.paper.tables import Evaluations, paper_tables, row_result
from experiments.settings import SettingsError
from experiments.stages import dataset_of
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import differences
from mfvpr.report import Table, write_json, write_table
from mfvpr.report.pages.one_run import PAGE
from mfvpr.reranking.results import FILTER
from mfvpr.utils import InputError

_BEST = ("mix_hist_50", "aliked_hist_50", "sift_hist_50")  # the first at hand shows its failures

Folders = Mapping[tuple[str, str], Path]  # run folders by data set and evaluation


def paper(settings: dict[str, Any]) -> None:
    """Evaluate what is not evaluated yet, then write tables and figures, and print the recalls."""
    rows = systems.chosen_rows(settings["systems"])
    places, missing = systems.places(settings["data"], settings["datasets"])
    rows, lacking = _with_weights(rows, places, settings)
    out = Path(settings["out"]).expanduser()
    if places and rows:
        tell(_plan(rows, places, settings))
    for line in (*missing, *lacking):
        tell(f"left out: {line}")
    if not places or not rows:
        raise SettingsError("nothing to evaluate: the lines above say what is missing")
    with runs.held(out):
        _evaluate_and_report(rows, places, settings, out, [*missing, *lacking])


def _names(rows: Sequence[Row]) -> list[str]:
    """Evaluations that give the rows."""
    return list(dict.fromkeys(row.run for row in rows))


def _plan(rows: Sequence[Row], places: Sequence[Place], settings: Mapping[str, Any]) -> str:
    """One line with the evaluations, the data sets, and the number of finished evaluations."""
    names = _names(rows)
    return (
        f"plan: {len(names)} evaluations ({', '.join(names)}) on each of {len(places)} data sets "
        f"({', '.join(place.name for place in places)}), {len(_finished_runs(rows, places, settings))} of "
        f"{len(names) * len(places)} finished; then tables, seconds of a query, and figures in {settings['out']}"
    )


def _evaluate_and_report(
    rows: Sequence[Row], places: Sequence[Place], settings: Mapping[str, Any], out: Path, left_out: Sequence[str]
) -> None:
    datasets, failures = evaluate_all(rows, places, settings)
    readable = [place for place in places if place.name in datasets]
    if not readable:
        raise SettingsError(f"nothing was evaluated: {failures[0]}")
    folders = _finished_runs(rows, readable, settings)
    results = {
        (row.name, place): result
        for (place, run), folder in folders.items()
        for row in rows
        if row.run == run and (result := row_result(row, runs.results(folder), runs.asked(folder)))
    }
    timed_on = next((place for place in readable if place.name == "robotcar_seasons"), readable[0])
    about = f"{timed_on.name}, on {timing.device()['cores']} cores of {timing.device()['device']}"
    evaluations = Evaluations(rows, datasets, results, {}, _sizes(rows, folders), about)
    for name, (heading, table) in _write_tables(out, evaluations).items():  # before the seconds, which take a while
        if name in ("recall", "averages"):
            print(f"\n{heading}\n\n{table.text()}", end="", flush=True)
    times = measure_times(rows, timed_on, datasets[timed_on.name], settings, out)
    seconds = {row.name: times[row.run] for row in rows if row.run in times and row.leads}
    _write(out, replace(evaluations, seconds=seconds), folders, [*left_out, *failures])
    if failures:
        raise SettingsError(f"{len(failures)} of the evaluations could not be made: {failures[0]}")


def _with_weights(
    rows: Sequence[Row], places: Sequence[Place], settings: Mapping[str, Any]
) -> tuple[list[Row], list[str]]:
    """Rows whose networks are installed, and a line for each evaluation that lacks one."""
    lines: dict[str, str] = {}
    for run in _names(rows) if places else ():
        if entries := systems.missing_weights(runs.settings_of(run, places[0], settings)):
            needs = "; ".join(f"{entry.name} ({entry.file}): {how_to_install(entry)}" for entry in entries)
            lines[run] = f"{run}: needs {needs}"
    return [row for row in rows if row.run not in lines], list(lines.values())


def evaluate_all(
    rows: Sequence[Row], places: Sequence[Place], settings: Mapping[str, Any]
) -> tuple[dict[str, Dataset], list[str]]:
    """Evaluate; return the data sets that could be read, and a line for each evaluation that failed."""
    names = _names(rows)
    total = len(places) * len(names)
    datasets: dict[str, Dataset] = {}
    failures: list[str] = []
    finished = 0

    def fail(line: str) -> None:
        failures.append(line)
        tell(f"left out: {line}")

    for number, place in enumerate(places):
        try:
            chosen = runs.settings_of(names[0], place, settings)
            dataset = dataset_of(chosen["dataset"])
            cache = build.cache(chosen)
            folders = {sequence.name: sequence.images for sequence in dataset.sequences}
            folders |= {"the database": dataset.database}
            images = {side: cache.contents(folder).fingerprint for side, folder in folders.items()}
            right = truth.fingerprint(dataset, truth.thresholds(chosen, dataset.sequences[0].truth))
        except InputError as error:
            fail(f"{place.name}: {error}")
            continue
        datasets[place.name] = dataset
        for difference in differences(dataset):
            tell(f"warning: {place.name}: {difference}; its numbers are not comparable")
        for turn, run in enumerate(names, start=1):
            chosen = runs.settings_of(run, place, settings)
            folder, expected = runs.folder_of(run, place, settings), runs.made_of(chosen, images, right)
            if runs.is_done(folder, expected):
                runs.page(folder)
                finished += 1
                continue
            tell(f"{number * len(names) + turn} of {total}: {run} on {place.name}")
            try:
                runs.evaluate(chosen, expected)
                runs.page(folder)
            except InputError as error:
                fail(f"{run} on {place.name}: {error}")
    if finished:
        tell(f"{finished} of {total} evaluations were finished before")
    return datasets, failures


def measure_times(
    rows: Sequence[Row], place: Place, dataset: Dataset, settings: Mapping[str, Any], out: Path
) -> dict[str, dict[str, Any]]:
    """Seconds by finished evaluation on a data set, measured once for the same settings, data and device."""
    times = {}
    for (_, run), folder in _finished_runs(rows, [place], settings).items():
        path = out / "seconds" / f"{run}.json"
        about = {"data_set": place.name, "of": runs.origin(folder)} | timing.device()
        known = _read(path)
        if any(known.get(name) != value for name, value in about.items()):
            tell(f"timing: {run} on {place.name}")
            try:
                known = timing.measure_query(runs.settings_of(run, place, settings), dataset) | about
            except InputError as error:
                tell(f"left out: seconds of {run}: {error}")
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, known)
        times[run] = known
    return times


def _read(path: Path) -> dict[str, Any]:
    """A JSON object; an empty one for a missing or damaged file."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _sizes(rows: Sequence[Row], folders: Folders) -> dict[tuple[str, str], float]:
    """Bytes of an image by row and data set; retrieval alone has no local features."""
    sizes = {key: runs.sizes(folder) for key, folder in folders.items()}
    return {
        (row.name, place): size["descriptor"] + (0 if row.ranking == FILTER else size["local"])
        for row in rows
        for (place, run), size in sizes.items()
        if run == row.run and (row.leads or row.ranking == FILTER)
    }


def _finished_runs(
    rows: Sequence[Row], places: Sequence[Place], settings: Mapping[str, Any]
) -> dict[tuple[str, str], Path]:
    folders = {(place.name, run): runs.folder_of(run, place, settings) for place in places for run in _names(rows)}
    return {key: folder for key, folder in folders.items() if runs.is_finished(folder)}


def _write_tables(out: Path, evaluations: Evaluations) -> dict[str, tuple[str, Table]]:
    shutil.rmtree(out / "tables", ignore_errors=True)  # it may have tables of other rows and data sets
    tables = {name: (heading, table) for name, heading, table in paper_tables(evaluations)}
    for name, (heading, table) in tables.items():
        write_table(out / "tables", table, heading, name=name)
    return tables


def _write(out: Path, evaluations: Evaluations, folders: Folders, left_out: Sequence[str]) -> None:
    for name in ("figures", "comparisons"):  # likewise
        shutil.rmtree(out / name, ignore_errors=True)
    tables = _write_tables(out, evaluations)
    best = [row for name in _BEST for row in evaluations.rows if row.name == name]
    growth = _growth(best, evaluations, folders, out)
    shown = {name: folders[name, row.run] for name in evaluations.datasets for row in reversed(best)
             if (name, row.run) in folders}  # fmt: skip
    for name, draw in paper_figures(evaluations, shown, growth):
        draw(out / "figures" / name)
    write_pages(out, evaluations, tables, growth, folders, left_out)
    print(f"\ntables and figures: {out}\nreport: {out / PAGE}")


def _growth(rows: Sequence[Row], evaluations: Evaluations, folders: Folders, out: Path) -> dict[str, dict[int, float]]:
    """Seconds of a query of some systems by the size of the database; the search is measured once."""
    path, device = out / "seconds" / "growth.json", timing.device()
    known = _read(path)
    if known.get("device") != device:
        known = {"device": device, "search": {}}
    lengths = {run: int(runs.sizes(folder)["descriptor"]) for (_, run), folder in folders.items()}
    growth = {}
    for row in rows:
        if row.name not in evaluations.seconds or row.run not in lengths:
            continue
        length = str(lengths[row.run])
        if length not in known["search"]:
            known["search"][length] = {str(size): value for size, value in timing.search(lengths[row.run]).items()}
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, known)
        rest = sum(evaluations.seconds[row.name][step] for step in timing.STEPS)
        growth[row.title] = {int(size): rest + value for size, value in known["search"][length].items()}
    return growth
