"""The paper's evaluation as a program: every system on every data set at hand, then tables and figures."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.paper import runs, systems
from experiments.paper.pages import paper_figures, write_pages
from experiments.paper.systems import Place, Row
from experiments.paper.tables import Evaluations, paper_tables, row_result
from mfvpr.checkpoints import how_to_install
from mfvpr.cli import jobs
from mfvpr.cli.console import tell
from mfvpr.cli.jobs import cache_of, dataset_of, describe_truth
from mfvpr.cli.schema import Paper
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.report import Table, write_json, write_table
from mfvpr.report.rendering import PAGE
from mfvpr.report.runs import LAST
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user


def paper(settings: Paper) -> None:
    """Evaluate what is not evaluated yet, then write tables and figures, and print the recalls."""
    rows = systems.chosen_rows(settings.systems)
    places, absent, refused = systems.places(settings.data, settings.datasets)
    lacking: dict[str, str] = {}  # a line for each evaluation whose networks are not installed
    for run in _names(rows) if places else ():
        if missing := systems.missing_weights(runs.settings_of(run, places[0], settings)):
            needs = [f"{entry.name} ({entry.file}): {how_to_install(entry)}" for entry in missing]
            lacking[run] = f"{run}: needs {'; '.join(needs)}"
    rows = [row for row in rows if row.run not in lacking]
    left_out = [*absent.values(), *refused, *lacking.values()]
    if not places or not rows:
        for line in left_out:
            tell(f"left out: {line}")
        raise InputError("nothing to evaluate: the lines above say what is missing")
    names, known = _names(rows), [place.name for place in places]
    tell(
        f"plan: {len(names)} evaluations ({', '.join(names)}) on each of {len(places)} data sets ({', '.join(known)}), "
        f"{len(_finished_runs(rows, known, settings))} of {len(names) * len(places)} finished; then tables, seconds of "
        f"a query, and figures in {settings.out}"
    )
    groups = {
        f"data sets that are not in {settings.data or 'data=DIR'}, see `mfvpr data list`": absent,
        "evaluations without their weights, see `mfvpr weights list`": lacking,
    }
    parts = [f"{len(members)} {words} ({', '.join(members)})" for words, members in groups.items() if members]
    for line in [*(["; ".join(parts)] if parts else []), *refused]:
        tell(f"left out: {line}")
    out = expand_user(settings.out)
    with runs.lock_output(out):
        _evaluate_and_report(rows, places, settings, out, left_out)


def _names(rows: Sequence[Row]) -> list[str]:
    """Evaluations that give the rows."""
    return list(dict.fromkeys(row.run for row in rows))


def _evaluate_and_report(
    rows: Sequence[Row], places: Sequence[Place], settings: Paper, out: Path, left_out: Sequence[str]
) -> None:
    datasets, failures = evaluate_all(rows, places, settings)
    if not datasets:
        raise InputError(f"nothing was evaluated: {failures[0]}")
    evaluations = _read_evaluations(rows, datasets, settings)
    name = "robotcar_seasons" if "robotcar_seasons" in datasets else next(iter(datasets))
    timed_on = next(place for place in places if place.name == name)
    about = f"{timed_on.name}, on {runs.device()['cores']} cores of {runs.device()['device']}"
    evaluations = replace(evaluations, timed_on=about)
    for name, (heading, table) in _write_tables(out, evaluations).items():  # before the seconds, which take a while
        if name in ("recall", "averages"):
            print(f"\n{heading}\n\n{table.text()}", end="", flush=True)
    times = measure_times(rows, timed_on, datasets[timed_on.name], settings, out)
    leading = {row.name: times[row.run] for row in rows if row.run in times and row.leads}
    evaluations = replace(evaluations, seconds=leading)
    for name in ("figures", "comparisons"):  # they may have those of other rows and data sets
        shutil.rmtree(out / name, ignore_errors=True)
    (out / "figures").mkdir()
    tables = _write_tables(out, evaluations)
    for name, draw in paper_figures(evaluations):
        draw(out / "figures" / name)
    write_pages(out, evaluations, tables, [*left_out, *failures])
    print(f"\ntables and figures: {out}\nreport: {out / PAGE}")
    if failures:
        raise InputError(f"{len(failures)} of the evaluations could not be made: {failures[0]}")


def evaluate_all(rows: Sequence[Row], places: Sequence[Place], settings: Paper) -> tuple[dict[str, Dataset], list[str]]:
    """Evaluate; return readable data sets, and a line per failed evaluation."""
    names = _names(rows)
    total, finished = len(places) * len(names), 0
    datasets: dict[str, Dataset] = {}
    failures: list[str] = []

    def fail(line: str) -> None:
        failures.append(line)
        tell(f"left out: {line}")

    for number, place in enumerate(places):
        try:
            chosen = runs.settings_of(names[0], place, settings)
            dataset = dataset_of(chosen.dataset)
            description = describe_truth(chosen.dataset, chosen.recall, dataset)
            cache = cache_of(chosen)
            folders = {sequence.name: sequence.images for sequence in dataset.sequences}
            folders |= {"the database": dataset.database}
            images = {side: cache.recipes.contents(folder).fingerprint for side, folder in folders.items()}
            correct = dataset.positives_fingerprint(description.get("thresholds", []))
        except InputError as error:
            fail(f"{place.name}: {error}")
            continue
        datasets[place.name] = dataset
        for difference in published_differences(dataset):
            tell(f"warning: {place.name}: {difference}; its numbers are not comparable")
        for turn, run in enumerate(names, start=number * len(names) + 1):
            chosen, folder = runs.settings_of(run, place, settings), runs.folder_of(run, place.name, settings)
            inputs = runs.input_fingerprints(chosen, images, correct)
            if runs.is_finished_with(inputs, folder):
                finished += 1
            else:
                tell(f"{turn} of {total}: {run} on {place.name}")
                try:
                    runs.evaluate(chosen, inputs)
                except InputError as error:
                    fail(f"{run} on {place.name}: {error}")
                    continue
            if not (folder / PAGE).is_file():
                jobs.report_page(folder)
    if finished:
        tell(f"{finished} of {total} evaluations were finished before")
    return datasets, failures


def _finished_runs(rows: Sequence[Row], datasets: Iterable[str], settings: Paper) -> dict[tuple[str, str], Path]:
    """Run folders by data set and evaluation."""
    folders = {(name, run): runs.folder_of(run, name, settings) for name in datasets for run in _names(rows)}
    return {key: folder for key, folder in folders.items() if (folder / LAST).is_file()}


def _read_evaluations(rows: Sequence[Row], datasets: Mapping[str, Dataset], settings: Paper) -> Evaluations:
    results, sizes, folders = {}, {}, _finished_runs(rows, datasets, settings)
    for (name, run), folder in folders.items():
        content, size = runs.read_json(folder / LAST), runs.read_json(folder / runs.SIZES)
        candidates = runs.read_json(folder / "run.json")["settings"]["candidates"]
        for row in (row for row in rows if row.run == run):
            if result := row_result(row, content, candidates):
                results[row.name, name] = result
            if row.leads or row.ranking == RETRIEVAL:  # retrieval alone has no local features
                of_image = size["descriptor"] + (0 if row.ranking == RETRIEVAL else size["local"])
                sizes[row.name, name] = of_image * len(datasets[name].database) / 2**20
    return Evaluations(rows, datasets, results, sizes=sizes, folders=folders)


def measure_times(
    rows: Sequence[Row], place: Place, dataset: Dataset, settings: Paper, out: Path
) -> dict[str, dict[str, Any]]:
    """Seconds by finished evaluation on a data set, measured once for the same settings, data and device."""
    times = {}
    for (_, run), folder in _finished_runs(rows, [place.name], settings).items():
        path = out / "seconds" / f"{run}.json"
        about = {"data_set": place.name, "of": runs.read_json(folder / runs.INPUTS)} | runs.device()
        times[run] = runs.read_json(path) or {}
        if any(times[run].get(name) != value for name, value in about.items()):
            tell(f"timing: {run} on {place.name}")
            try:
                times[run] = runs.measure_query(runs.settings_of(run, place, settings), dataset) | about
                write_json(path, times[run])
            except InputError as error:
                tell(f"left out: seconds of {run}: {error}")
                del times[run]
    return times


def _write_tables(out: Path, evaluations: Evaluations) -> dict[str, tuple[str, Table]]:
    """Write the tables; return headings and tables by name."""
    shutil.rmtree(out / "tables", ignore_errors=True)  # it may have tables of other rows and data sets
    tables = {name: (heading, table) for name, heading, table in paper_tables(evaluations)}
    for name, (heading, table) in tables.items():
        write_table(out / "tables", table, heading, name=name)
    return tables
