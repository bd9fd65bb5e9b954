"""The paper's evaluation as a program: every system on every data set at hand, then tables."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.paper import runs, systems
from experiments.paper.pages import write_pages
from experiments.paper.systems import LeftOut, Place, Row
from experiments.paper.tables import Evaluations, paper_tables, recalls_of
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

Folders = dict[tuple[str, str], Path]  # run folders by data set and evaluation


def paper(settings: Paper) -> None:
    """Evaluate unless finished runs exist, then write tables, and print the recalls."""
    rows = systems.chosen_rows(settings.systems)
    places, left_out = systems.places(settings.data, settings.datasets)
    for run in _names(rows) if places else ():
        if missing := systems.missing_weights(runs.settings_of(run, places[0], settings)):
            needs = [f"{entry.name} ({entry.file}): {how_to_install(entry)}" for entry in missing]
            left_out.append((run, f"needs {'; '.join(needs)}"))
            rows = [row for row in rows if row.run != run]
    for name, reason in left_out:
        tell(f"left out: {name}: {reason}")
    if not places or not rows:
        raise InputError("nothing to evaluate: the lines above say what is missing")
    names, out = _names(rows), expand_user(settings.out)
    folders = [runs.folder_of(run, place.name, settings) for place in places for run in names]
    tell(
        f"plan: {len(names)} evaluations ({', '.join(names)}) on each of {len(places)} data sets "
        f"({', '.join(place.name for place in places)}), {sum((folder / LAST).is_file() for folder in folders)} of "
        f"{len(folders)} finished; then seconds of a query, and tables in {out}"
    )
    with runs.lock_output(out):
        datasets, finished, failures = evaluate_all(names, places, settings)
        if not datasets:
            raise InputError(f"nothing was evaluated: {': '.join(failures[0])}")
        evaluations = read_evaluations(rows, datasets, finished)
        name, device = "robotcar_seasons" if "robotcar_seasons" in datasets else next(iter(datasets)), runs.device()
        evaluations = replace(evaluations, timed_on=f"{name}, on {device['cores']} cores of {device['device']}")
        for table_name, heading, table in paper_tables(evaluations):  # before the seconds, which take a while
            if table_name in ("recall", "averages"):
                print(f"\n{heading}\n\n{table.text()}", end="", flush=True)
        [timed_on] = (place for place in places if place.name == name)
        times = {
            run: _measure_seconds(runs.settings_of(run, timed_on, settings), datasets[name], folder, device)
            for (dataset, run), folder in finished.items()
            if dataset == name
        }
        leading = {row.name: times[row.run] for row in rows if row.run in times and row.leads}
        for table_folder in ("tables", "comparisons"):  # they may have those of other rows and data sets
            shutil.rmtree(out / table_folder, ignore_errors=True)
        evaluations = replace(evaluations, seconds=leading)
        tables = {table_name: (heading, table) for table_name, heading, table in paper_tables(evaluations)}
        for table_name, (heading, table) in tables.items():
            write_table(out / "tables", table, heading, name=table_name)
        write_pages(out, evaluations, tables, [*left_out, *failures])
        print(f"\ntables: {out}\nreport: {out / PAGE}")
    if failures:
        raise InputError(f"{len(failures)} of the evaluations could not be made: {': '.join(failures[0])}")


def _names(rows: Sequence[Row]) -> list[str]:
    """Evaluations that give the rows."""
    return list(dict.fromkeys(row.run for row in rows))


def evaluate_all(
    names: Sequence[str], places: Sequence[Place], settings: Paper
) -> tuple[dict[str, Dataset], Folders, list[LeftOut]]:
    """Evaluate; return readable data sets, run folders of finished evaluations, and the failed ones."""
    datasets, finished, failures = dict[str, Dataset](), Folders(), list[LeftOut]()

    def fail(name: str, error: InputError) -> None:
        failures.append((name, str(error)))
        tell(f"left out: {name}: {error}")

    for number, place in enumerate(places):
        try:
            chosen = runs.settings_of(names[0], place, settings)
            dataset, cache = dataset_of(chosen.dataset), cache_of(chosen)
            thresholds = describe_truth(chosen.dataset, chosen.recall, dataset).get("thresholds", [])
            sides = {sequence.name: sequence.images for sequence in dataset.sequences}
            sides |= {"the database": dataset.database}
            images = {side: cache.recipes.contents(folder).fingerprint for side, folder in sides.items()}
            correct = dataset.positives_fingerprint(thresholds)
        except InputError as error:
            fail(place.name, error)
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
                    fail(f"{run} on {place.name}", error)
                    continue
            finished[place.name, run] = folder
            if not (folder / PAGE).is_file():
                write_report(folder)
    return datasets, finished, failures


def read_evaluations(rows: Sequence[Row], datasets: Mapping[str, Dataset], finished: Folders) -> Evaluations:
    """Recalls, settings and sizes of all rows."""
    evaluations = Evaluations(rows, datasets, {}, folders=finished)
    for (name, run), folder in finished.items():
        content, size = runs.read_json(folder / LAST), runs.read_json(folder / runs.SIZES)
        for row in (row for row in rows if row.run == run):
            evaluations.recalls.update(recalls_of(row, name, content))
            if row.leads or row.ranking == RETRIEVAL:  # retrieval alone has no local features
                of_image = size["descriptor"] + (0 if row.ranking == RETRIEVAL else size["local"])
                evaluations.sizes[row.name, name] = of_image * len(datasets[name].database) / 2**20
    return evaluations


def _measure_seconds(settings: Any, dataset: Dataset, folder: Path, device: Mapping[str, Any]) -> dict[str, Any]:
    """Seconds of a query, measured once on a device for a run folder."""
    seconds = runs.read_json(folder / runs.SECONDS) or {}
    if seconds.get("measured_on") != device:
        tell(f"timing: {folder.name} on {dataset.name}")
        seconds = runs.measure_query(settings, dataset) | {"measured_on": device}
        write_json(folder / runs.SECONDS, seconds)
    return seconds
