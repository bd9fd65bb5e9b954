"""Convert the predictions of a run folder, or of lines of `mfvpr localize`, to files of other programs."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mfvpr.cli.inputs import dataset_of
from mfvpr.datasets import Dataset, QuerySequence, image_folder
from mfvpr.datasets.ground_truth import middle
from mfvpr.io import read_stamps, stamps_in_names
from mfvpr.io.containers import reading
from mfvpr.report import prediction_files
from mfvpr.report.evaluations import sequence_folder
from mfvpr.report.prediction_files import LocalizedImage
from mfvpr.report.runs import file_names
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable

_CANDIDATES = ("preds", "hloc", "kapture")


def convert(
    source: Path, out: Path, layout: str, poses: Path | None, times: Path | None, database: Path | None,
    query_prefix: str, database_prefix: str,
) -> None:  # fmt: skip
    """Write the predictions of an evaluation, or of localized images, and print the paths."""
    _check(source, layout, poses, times, database)
    if (prefixes := (query_prefix, database_prefix)) != ("", "") and layout not in ("hloc", "kapture"):
        raise InputError(f"--query-prefix, --database-prefix: expected none for --layout {layout}; remove them")
    if source.is_dir():
        dataset, thresholds = _dataset_of_run(source)
        if times and len(dataset.sequences) > 1:
            raise InputError(f"--times: expected one query sequence, got {len(dataset.sequences)}; name images by time")
        for target, sequence, images in _sequences(source, out, dataset):
            if layout in _CANDIDATES:
                _write_candidates(target, layout, images, sequence, dataset, thresholds, prefixes)
            else:
                _write_localized(target, layout, images, poses, dataset.database.names, times)
    else:
        names = image_folder(database).names if database else ()
        _write_localized(out, layout, prediction_files.read_lines(source), poses, names, times)


def _check(source: Path, layout: str, poses: Path | None, times: Path | None, database: Path | None) -> None:
    """Raise a InputError for arguments that do not belong together."""
    is_run, is_trajectory = source.is_dir(), layout in ("tum", "kitti")
    if layout in _CANDIDATES and not is_run:
        raise InputError(f"{source}: expected the run folder of mfvpr evaluate for --layout {layout}, got no folder")
    for name, value, is_needed in (
        ("poses", poses, is_trajectory), ("database", database, is_trajectory and not is_run)
    ):  # fmt: skip
        if is_needed != (value is not None):
            remedy = f"add --{name} PATH" if is_needed else f"remove --{name}"
            raise InputError(f"--{name}: expected {'a path' if is_needed else 'none'} for --layout {layout} of "
                                f"{source}, got {value}; {remedy}")  # fmt: skip
    if times and layout not in ("tum", "shifts"):
        raise InputError(f"--times: expected none for --layout {layout}, which has no times, got {times}")


def _dataset_of_run(folder: Path) -> tuple[Dataset, Sequence[float]]:
    """The data set of a run, and the thresholds of a correct prediction, if its truth says which images are correct."""
    with reading(folder / "run.json", mend="expected the folder of an evaluation"):
        about: Any = json.loads((folder / "run.json").read_text("utf-8"))
        settings, thresholds = about["settings"]["dataset"], about["ground_truth"].get("thresholds", [])
        thresholds = [] if settings.get("exclude_neighbors") is not None else thresholds  # they are not correct
    if "recall" not in about["settings"]:
        raise InputError(f"{folder}: expected a run of mfvpr evaluate, got one of Python; use "
                            "Result.write_predictions, or mfvpr.io.write_trajectory")  # fmt: skip
    return dataset_of(settings), thresholds


def _sequences(folder: Path, out: Path, dataset: Dataset) -> Iterator[tuple[Path, QuerySequence, list[LocalizedImage]]]:
    """Target, queries and predictions of each query sequence."""
    names = [sequence.name for sequence in dataset.sequences]
    for place, sequence in enumerate(dataset.sequences):
        target = out / file_names(names)[sequence.name] if len(names) > 1 else out
        queries = sequence_folder(folder, names, place)
        yield target, sequence, prediction_files.read_run_images(queries, sequence.images.names)


def _write_candidates(
    path: Path, layout: Any, images: Sequence[LocalizedImage], sequence: QuerySequence, dataset: Dataset,
    thresholds: Sequence[float], prefixes: tuple[str, str],
) -> None:  # fmt: skip
    shortlist = prediction_files.shortlist_of(images, dataset.database.names)
    positives = sequence.truth.positives(middle(thresholds)) if sequence.truth and thresholds else None
    sides = sequence.images, dataset.database
    prediction_files.write_candidates(path, shortlist, *sides, layout, positives, prefixes=prefixes)
    print(printable(f"{path}: candidates of {int(shortlist.mask.any(axis=1).sum())} queries"))


def _write_localized(
    path: Path, layout: str, images: Sequence[LocalizedImage], poses: Path | None, database: Sequence[str],
    times: Path | None,
) -> None:  # fmt: skip
    names = [image.name for image in images]
    stamps = [] if layout == "kitti" else read_stamps(times, len(names)) if times else stamps_in_names(names)
    if layout == "shifts":
        prediction_files.write_shift_table(path, images, stamps)
    elif poses is not None:
        prediction_files.write_poses(path, images, poses, database, None if layout == "kitti" else stamps)
    num_places = sum(image.place is not None for image in images)
    print(printable(f"{path}: {num_places} images with a place, {len(images) - num_places} without"))
