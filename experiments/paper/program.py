"""The paper's evaluation as a program: every system on every data set at hand, then tables and figures."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.paper import runs, systems
from experiments.paper.pages import draw_averages, write_pages
from experiments.paper.systems import Place, Row
from experiments.paper.tables import Evaluations, paper_tables, row_result
from mfvpr.checkpoints import how_to_install
from mfvpr.cli.console import tell
from mfvpr.cli.jobs import cache_of, dataset_of, describe_truth
from mfvpr.cli.schema import Paper
from mfvpr.datasets import Dataset
from mfvpr.datasets.published import published_differences
from mfvpr.evaluation.rankings import RETRIEVAL
from mfvpr.report import write_json, write_table
from mfvpr.report.pages import PAGE, write_report
from mfvpr.report.runs import LAST
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import expand_user


def paper(settings: Paper) -> None:
    """Evaluate what is not evaluated yet, then write tables and figures, and print the recalls."""
    rows = systems.chosen_rows(settings.systems)
    places, left_out = systems.places(settings.data, settings.datasets)
    for run in _names(rows) if places else ():
        if missing := systems.missing_weights(runs.settings_of(run, places[0], settings)):
            needs = [f"{entry.name} ({entry.file}): {how_to_install(entry)}" for entry in missing]
            left_out.append(f"{run}: needs {'; '.join(needs)}")
            rows = [row for row in rows if row.run != run]
    for line in left_out:
        tell(f"left out: {line}")
    if not places or not rows:
        raise InputError("nothing to evaluate: the lines above say what is missing")
    names, known = _names(rows), [place.name for place in places]
    tell(
        f"plan: {len(names)} evaluations ({', '.join(names)}) on each of {len(places)} data sets ({', '.join(known)}), "
        f"{len(_finished_runs(rows, known, settings))} of {len(names) * len(places)} finished; then tables, seconds of "
        f"a query, and figures in {settings.out}"
    )
    out = expand_user(settings.out)
    with runs.lock_output(out):
        datasets, failures = evaluate_all(rows, places, settings)
        if not datasets:
            raise InputError(f"nothing was evaluated: {failures[0]}")
        evaluations = _read_evaluations(rows, datasets, settings)
        name = "robotcar_seasons" if "robotcar_seasons" in datasets else next(iter(datasets))
        about = runs.device()
        evaluations = replace(evaluations, timed_on=f"{name}, on {about['cores']} cores of {about['device']}")
        for table_name, heading, table in paper_tables(evaluations):  # before the seconds, which take a while
            if table_name in ("recall", "averages"):
                print(f"\n{heading}\n\n{table.text()}", end="", flush=True)
        timed_on = next(place for place in places if place.name == name)
        times = measure_times(rows, timed_on, datasets[name], settings, out)
        leading = {row.name: times[row.run] for row in rows if row.run in times and row.leads}
        _write_output(out, replace(evaluations, seconds=leading), [*left_out, *failures])
    if failures:
        raise InputError(f"{len(failures)} of the evaluations could not be made: {failures[0]}")


def _write_output(out: Path, evaluations: Evaluations, left_out: Sequence[str]) -> None:
    for name in ("tables", "figures", "comparisons"):  # they may have those of other rows and data sets
        shutil.rmtree(out / name, ignore_errors=True)
    (out / "figures").mkdir()
    tables = {name: (heading, table) for name, heading, table in paper_tables(evaluations)}
    for name, (heading, table) in tables.items():
        write_table(out / "tables", table, heading, name=name)
    draw_averages(out / "figures" / "averages.png", evaluations)
    write_pages(out, evaluations, tables, left_out)
    print(f"\ntables and figures: {out}\nreport: {out / PAGE}")


def _names(rows: Sequence[Row]) -> list[str]:
    """Evaluations that give the rows."""
    return list(dict.fromkeys(row.run for row in rows))


def evaluate_all(rows: Sequence[Row], places: Sequence[Place], settings: Paper) -> tuple[dict[str, Dataset], list[str]]:
    """Evaluate; return readable data sets, and a line per failed evaluation."""
    names, datasets, failures = _names(rows), dict[str, Dataset](), list[str]()

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
            if not runs.is_finished_with(inputs, folder):
                tell(f"{turn} of {len(places) * len(names)}: {run} on {place.name}")
                try:
                    runs.evaluate(chosen, inputs)
                except InputError as error:
                    fail(f"{run} on {place.name}: {error}")
                    continue
            if not (folder / PAGE).is_file():
                write_report(folder)
    return datasets, failures


def _finished_runs(rows: Sequence[Row], datasets: Iterable[str], settings: Paper) -> dict[tuple[str, str], Path]:
    """Run folders by data set and evaluation."""
    folders = {(name, run): runs.folder_of(run, name, settings) for name in datasets for run in _names(rows)}
    return {key: folder for key, folder in folders.items() if (folder / LAST).is_file()}


def _read_evaluations(rows: Sequence[Row], datasets: Mapping[str, Dataset], settings: Paper) -> Evaluations:
    results, sizes, folders = {}, {}, _finished_runs(rows, datasets, settings)
    for (name, run), folder in folders.items():
        content, size = runs.read_json(folder / LAST), runs.read_json(folder / runs.SIZES)
        for row in (row for row in rows if row.run == run):
            if result := row_result(row, content):
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
            times[run] = runs.measure_query(runs.settings_of(run, place, settings), dataset) | about
            write_json(path, times[run])
    return times
