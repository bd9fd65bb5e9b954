"""Every system on every data set that is here; then tables and figures of them all."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments import build, truth
from experiments.console import tell
from experiments.errors import how_to_install
from experiments.paper import figures, pages, runs, systems, timing
from experiments.paper.systems import Place, Row
from experiments.paper.tables import Evaluated, Found, evaluated, tables
from experiments.settings import SettingsError
from experiments.stages import dataset_of
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import differences
from mfvpr.report import Table
from mfvpr.report import runs as run_folders
from mfvpr.report.pages.one_run import PAGE
from mfvpr.reranking.results import FILTER
from mfvpr.utils import InputError

_BEST = ("mix_hist_50", "aliked_hist_50", "sift_hist_50")  # whose failures are shown: the first that is here


def paper(settings: dict[str, Any]) -> None:
    """Evaluate what is not evaluated yet, then write tables and figures, and print the recalls."""
    rows = systems.chosen_rows(settings["systems"])
    found, missing = systems.places(settings["data"], settings["datasets"])
    rows, lacking = _with_weights(rows, found, settings)
    out = Path(settings["out"]).expanduser()
    if found and rows:
        tell(_plan(rows, found, settings))
    for line in (*missing, *lacking):
        tell(f"left out: {line}")
    if not found or not rows:
        raise SettingsError("nothing to evaluate: the lines above say what is missing")
    with runs.held(out):
        _make(rows, found, settings, out, [*missing, *lacking])


def _plan(rows: Sequence[Row], found: Sequence[Place], settings: Mapping[str, Any]) -> str:
    """Announce evaluations, data sets and what is finished, in one line."""
    names = list(dict.fromkeys(row.run for row in rows))
    done = sum(runs.is_finished(runs.folder_of(run, place, settings)) for place in found for run in names)
    return (
        f"plan: {len(names)} evaluations ({', '.join(names)}) on each of {len(found)} data sets "
        f"({', '.join(place.name for place in found)}), {done} of {len(names) * len(found)} finished; then tables, "
        f"seconds of a query, and figures in {settings['out']}"
    )


def _make(
    rows: Sequence[Row], found: Sequence[Place], settings: Mapping[str, Any], out: Path, left_out: Sequence[str]
) -> None:
    datasets, failed = evaluate_all(rows, found, settings)
    here = [place for place in found if place.name in datasets]
    if not here:
        raise SettingsError(f"nothing was evaluated: {failed[0]}")
    finished = _finished(rows, here, settings)
    results = _collected(rows, finished)
    timed_on = next((one for one in here if one.name == "robotcar_seasons"), here[0])
    about = f"{timed_on.name}, on {timing.device()['cores']} cores of {timing.device()['device']}"
    whole = Found(rows, datasets, results, {}, _sizes(rows, finished), about)
    for name, (heading, table) in _write_tables(out, whole).items():  # before the seconds, which take a while
        if name in ("recall", "averages"):
            print(f"\n{heading}\n\n{table.text()}", end="", flush=True)
    times = measure_times(rows, timed_on, datasets[timed_on.name], settings, out)
    seconds = {row.name: times[row.run] for row in rows if row.run in times and row.leads}
    _write(out, replace(whole, seconds=seconds), finished, [*left_out, *failed])
    if failed:
        raise SettingsError(f"{len(failed)} of the evaluations could not be made: {failed[0]}")


def _with_weights(
    rows: Sequence[Row], found: Sequence[Place], settings: Mapping[str, Any]
) -> tuple[list[Row], list[str]]:
    """Rows whose networks are installed, and a line for each evaluation whose are not."""
    lines: dict[str, str] = {}
    for run in dict.fromkeys(row.run for row in rows) if found else ():
        if entries := systems.missing_weights(runs.settings_of(run, found[0], settings)):
            needs = "; ".join(f"{entry.name} ({entry.file}): {how_to_install(entry)}" for entry in entries)
            lines[run] = f"{run}: needs {needs}"
    return [row for row in rows if row.run not in lines], list(lines.values())


def evaluate_all(
    rows: Sequence[Row], found: Sequence[Place], settings: Mapping[str, Any]
) -> tuple[dict[str, Dataset], list[str]]:
    """The data sets that could be read, and a line for each evaluation that could not be made."""
    names = list(dict.fromkeys(row.run for row in rows))
    datasets: dict[str, Dataset] = {}
    failed: list[str] = []
    before = 0
    for number, place in enumerate(found):
        try:
            chosen = runs.settings_of(names[0], place, settings)
            datasets[place.name] = dataset = dataset_of(chosen["dataset"])
            archive = build.archive(chosen)
            sides = {one.name: one.images for one in dataset.sequences} | {"the database": dataset.database}
            images = {side: archive.contents(folder).fingerprint for side, folder in sides.items()}
            right = truth.fingerprint(dataset, truth.thresholds(chosen, dataset.sequences[0].truth))
        except InputError as error:
            datasets.pop(place.name, None)
            failed.append(f"{place.name}: {error}")
            tell(f"left out: {failed[-1]}")
            continue
        for difference in differences(dataset):
            tell(f"warning: {place.name}: {difference}; its numbers are not comparable")
        for turn, run in enumerate(names):
            chosen = runs.settings_of(run, place, settings)
            folder, expected = runs.folder_of(run, place, settings), runs.made_of(chosen, images, right)
            if runs.is_done(folder, expected):
                runs.page(folder)
                before += 1
                continue
            tell(f"{number * len(names) + turn + 1} of {len(found) * len(names)}: {run} on {place.name}")
            try:
                runs.evaluate(chosen, expected)
                runs.page(folder)
            except InputError as error:
                failed.append(f"{run} on {place.name}: {error}")
                tell(f"left out: {failed[-1]}")
    if before:
        tell(f"{before} of {len(found) * len(names)} evaluations were finished before")
    return datasets, failed


def _collected(rows: Sequence[Row], finished: Mapping[tuple[str, str], Path]) -> dict[tuple[str, str], Evaluated]:
    collected = {}
    for (place, run), folder in finished.items():
        found, asked = runs.results(folder), runs.asked(folder)
        for row in rows:
            if row.run == run and (one := evaluated(row, found, asked)):
                collected[row.name, place] = one
    return collected


def measure_times(
    rows: Sequence[Row], place: Place, dataset: Dataset, settings: Mapping[str, Any], out: Path
) -> dict[str, dict[str, Any]]:
    """Seconds by evaluation that is finished on a data set; measured once of the same settings, data and device."""
    times = {}
    for run in dict.fromkeys(row.run for row in rows):
        folder, path = runs.folder_of(run, place, settings), out / "seconds" / f"{run}.json"
        if not runs.is_finished(folder):
            continue
        about = {"data_set": place.name, "of": runs.origin(folder)} | timing.device()
        known = _read(path)
        if any(known.get(name) != value for name, value in about.items()):
            tell(f"timing: {run} on {place.name}")
            try:
                known = timing.measured(runs.settings_of(run, place, settings), dataset) | about
            except InputError as error:
                tell(f"left out: seconds of {run}: {error}")
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            run_folders.write_json(path, known)
        times[run] = known
    return times


def _read(path: Path) -> dict[str, Any]:
    """A JSON object; an empty one where there is none, or a damaged one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _sizes(rows: Sequence[Row], finished: Mapping[tuple[str, str], Path]) -> dict[tuple[str, str], float]:
    """Bytes of an image by row and data set: of a filter alone without local features."""
    found = {key: runs.sizes(folder) for key, folder in finished.items()}
    return {
        (row.name, place): one["descriptor"] + (0 if row.ranking == FILTER else one["local"])
        for row in rows
        for (place, run), one in found.items()
        if run == row.run and (row.leads or row.ranking == FILTER)
    }


def _finished(rows: Sequence[Row], here: Sequence[Place], settings: Mapping[str, Any]) -> dict[tuple[str, str], Path]:
    """Run folders by data set and evaluation."""
    names = dict.fromkeys(row.run for row in rows)
    folders = {(place.name, run): runs.folder_of(run, place, settings) for place in here for run in names}
    return {key: folder for key, folder in folders.items() if runs.is_finished(folder)}


def _write_tables(out: Path, found: Found) -> dict[str, tuple[str, Table]]:
    shutil.rmtree(out / "tables", ignore_errors=True)  # of other rows and data sets, perhaps
    table_of = {name: (heading, table) for name, heading, table in tables(found)}
    for name, (heading, table) in table_of.items():
        run_folders.write_table(out / "tables", table, heading, name=name)
    return table_of


def _write(out: Path, found: Found, finished: Mapping[tuple[str, str], Path], left_out: Sequence[str]) -> None:
    for name in ("figures", "comparisons"):  # likewise
        shutil.rmtree(out / name, ignore_errors=True)
    table_of = _write_tables(out, found)
    best = [row for name in _BEST for row in found.rows if row.name == name]
    growth = _growth(best, found, finished, out)
    shown = {}
    for name in found.datasets:
        folders = (finished[name, row.run] for row in best if (name, row.run) in finished)
        if folder := next(folders, None):
            shown[name] = folder
    for name, draw in figures.figures(found, shown, growth):
        draw(out / "figures" / name)
    pages.write(out, found, table_of, growth, finished, left_out)
    print(f"\ntables and figures: {out}\nreport: {out / PAGE}")


def _growth(
    rows: Sequence[Row], found: Found, finished: Mapping[tuple[str, str], Path], out: Path
) -> dict[str, dict[int, float]]:
    """Seconds of a query of some systems by the size of the database; the search is measured once."""
    path, device = out / "seconds" / "growth.json", timing.device()
    known = _read(path)
    if known.get("device") != device:
        known = {"device": device, "search": {}}
    lengths = {run: int(runs.sizes(folder)["descriptor"]) for (_, run), folder in finished.items()}
    growth = {}
    for row in rows:
        if row.name not in found.seconds or row.run not in lengths:
            continue
        length = str(lengths[row.run])
        if length not in known["search"]:
            known["search"][length] = {str(size): value for size, value in timing.search(lengths[row.run]).items()}
            path.parent.mkdir(parents=True, exist_ok=True)
            run_folders.write_json(path, known)
        rest = sum(found.seconds[row.name][step] for step in timing.STEPS)
        growth[row.title] = {int(size): rest + value for size, value in known["search"][length].items()}
    return growth
