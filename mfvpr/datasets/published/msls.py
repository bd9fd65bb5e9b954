"""The validation part of Mapillary Street-Level Sequences (Warburg et al., CVPR 2020)."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.ground_truth import FARTHEST, FrameTruth, RadiusTruth
from mfvpr.datasets.positives import rows_within
from mfvpr.datasets.published.lists import listed_images, read_names, read_rows
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import require_file
from mfvpr.utils.numbers import parse_number

CITIES = ("cph", "sf")
REACH = 25.0  # meters, within which a query has to have an answer to be asked
TABLES = ("raw", "postprocessed", "subtask_index")
LAYOUT = """train_val/cph/database/images/*.jpg, raw.csv, postprocessed.csv, subtask_index.csv
train_val/cph/query, train_val/sf/database, train_val/sf/query  the same; or, as GSV-Cities has them,
msls_val_dbImages.npy, msls_val_qImages.npy, msls_val_qIdx.npy, msls_val_pIdx.npy  instead of the tables"""


def msls_val(root: Path, name: str) -> Dataset:
    """Copenhagen and San Francisco, without panoramas; queries with an answer within 25 m, as its own code has it.

    Raises:
        InputError: tables, lists or images are missing or damaged.
    """
    parts = {part: root / f"{name}_{part}.npy" for part in ("dbImages", "qImages", "qIdx", "pIdx")}
    there = [path.is_file() for path in parts.values()]
    if all(there):
        return _of_lists(root, name, parts)
    if any(there):
        missing = next(path for path in parts.values() if not path.is_file())
        raise InputError(f"{missing}: expected beside the other lists, found nothing; get all four")
    return _of_tables(root, name)


def _of_lists(root: Path, name: str, parts: dict[str, Path]) -> Dataset:
    database = listed_images(root, read_names(parts["dbImages"]), parts["dbImages"])
    names, rows = read_names(parts["qImages"]), read_rows(parts["pIdx"], len(database))
    asked = [row for found in read_rows(parts["qIdx"], len(names)) for row in found]
    if len(asked) != len(rows):
        raise InputError(f"{parts['pIdx']}: expected rows of the {len(asked)} queries of msls_val_qIdx.npy, got "
                         f"{len(rows)}")  # fmt: skip
    queries = listed_images(root, [names[row] for row in asked], parts["qImages"])
    truth = FrameTruth(tuple(rows), len(database), widened=False)
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _of_tables(root: Path, name: str) -> Dataset:
    sides = {}
    for side in ("database", "query"):
        found = [one for city in CITIES for one in _images(root / "train_val" / city / side, root)]
        names = [one for one, _ in found]
        sides[side] = names, np.array([place for _, place in found], np.float64).reshape(-1, 2)
    (database, places), (queries, positions) = sides["database"], sides["query"]
    asked = [row for row, near in enumerate(rows_within(positions, places, REACH)) if len(near)]
    images = listed_images(root, database, root / "train_val")
    sequence = listed_images(root, [queries[row] for row in asked], root / "train_val")
    return Dataset(name, images, (QuerySequence(name, sequence, RadiusTruth(positions[asked], places)),))


def _images(folder: Path, root: Path) -> Iterator[tuple[str, tuple[float, float]]]:
    """Name and position of what the task "all" takes, without panoramas."""
    raw, processed, tasks = (_table(folder / f"{name}.csv") for name in TABLES)
    if not raw.keys() == processed.keys() == tasks.keys():
        raise InputError(f"{folder}: expected the same keys in {', '.join(f'{name}.csv' for name in TABLES)}, got "
                         f"{len(raw)}, {len(processed)} and {len(tasks)} keys with differences; get them "
                         "again")  # fmt: skip
    for key, line in processed.items():
        try:
            if _flag(raw[key]["pano"]) or not _flag(tasks[key]["all"]):
                continue
            position = parse_number(line["easting"]), parse_number(line["northing"])
            if not all(abs(meters) <= FARTHEST for meters in position):  # NaN neither
                raise ValueError
            yield f"{(folder / 'images').relative_to(root).as_posix()}/{key}.jpg", position
        except (AttributeError, KeyError, TypeError, ValueError):  # cells that a line lacks are None
            raise InputError(
                f"{folder}: key {key[:60]!r}: expected pano in raw.csv and all in subtask_index.csv (True or False), "
                "easting and northing in postprocessed.csv (meters); get them again"
            ) from None


def _flag(text: str) -> bool:
    """A flag as pandas reads it from a table."""
    return {"true": True, "1": True, "false": False, "0": False}[text.strip().lower()]


def _table(path: Path) -> dict[str, dict[str, str]]:
    """Lines by key."""
    require_file(path, "a table of the data set")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; get the whole data set") from None
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: expected a table of commas; get it again") from None
    table = {line.get("key") or "": line for line in lines}
    if len(table) < len(lines) or "" in table:
        raise InputError(f"{path}: expected a different key in every line, got {len(table)} in {len(lines)} lines; get "
                         "the table again")  # fmt: skip
    return table
