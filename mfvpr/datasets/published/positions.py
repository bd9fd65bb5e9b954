"""Published data sets with ground truth by position: Pittsburgh30k, Mapillary Street-Level Sequences."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.ground_truth import FARTHEST, RadiusTruth, require_positions
from mfvpr.datasets.positives import rows_within
from mfvpr.datasets.published.lists import dataset_of_lists, expected_file, listed_images
from mfvpr.io.checks import parse_number
from mfvpr.io.containers import reading
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.utils.errors import InputError

PITTSBURGH_LAYOUT = """000/*.jpg, ..., queries_real/000/*.jpg, ...
datasets/pitts30k_{part}.mat                                 lists and positions; or, as GSV-Cities has them,
pitts30k_{part}_dbImages.npy, _qImages.npy, _gt.npy (_gt_25m.npy)"""
QUERIES = "queries_real"
CITIES = ("cph", "sf")
REACH = 25.0  # meters; images without a database image within it are no queries
_FLAGS = {"true": True, "1": True, "false": False, "0": False}  # as pandas reads them
TABLES = ("raw", "postprocessed", "subtask_index")
MSLS_LAYOUT = """train_val/cph/database/images/*.jpg, raw.csv, postprocessed.csv, subtask_index.csv
train_val/cph/query, train_val/sf/database, train_val/sf/query  the same; or, as GSV-Cities has them,
msls_val_dbImages.npy, msls_val_qImages.npy, msls_val_qIdx.npy, msls_val_pIdx.npy  instead of the tables"""


def pitts30k(root: Path, name: str) -> Dataset:
    """The validation or test part of Pittsburgh30k (Torii et al., CVPR 2013; Arandjelovic et al., CVPR 2016).

    Database images are correct within a radius of the query, or within the lists' 25 m.
    """
    structure = f"{name}.mat"
    if path := expected_file(root, f"datasets/{structure}", structure):
        return _dataset_of_structure(root, name, path)
    lists = [expected_file(root, f"{name}_{part}.npy") for part in ("dbImages", "qImages", "gt_25m", "gt")]
    database, queries, *truths = lists
    if database is None or queries is None or not any(truths):
        raise InputError(f"{root}: expected datasets/{structure}, or {name}_dbImages.npy, {name}_qImages.npy and "
                         f"{name}_gt.npy, found neither; get the whole data set")  # fmt: skip
    return dataset_of_lists(root, name, database, queries, next(filter(None, truths)))


def _dataset_of_structure(root: Path, name: str, path: Path) -> Dataset:
    mend = f"expected the structure dbStruct of {name}; get the file again"
    with reading(path, mend=mend), path.open("rb") as file:
        arrays = read_matlab(file, text=True)
        sides = [_cell_texts(arrays, f"dbStruct.{field}.") for field in ("dbImageFns", "qImageFns")]
        positions = [arrays[f"dbStruct.{field}"].T.astype(np.float64) for field in ("utmDb", "utmQ")]
    for names, xy in zip(sides, positions, strict=True):
        require_positions(str(path), xy, len(names))
    database = listed_images(root, sides[0], path)
    queries = listed_images(root, [f"{QUERIES}/{query}" for query in sides[1]], path)
    truth = RadiusTruth(positions[1], positions[0])
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _cell_texts(arrays: dict[str, np.ndarray], prefix: str) -> list[str]:
    """Texts of a cell array, in order."""
    texts = {int(path.removeprefix(prefix)): str(text) for path, text in arrays.items() if path.startswith(prefix)}
    return [texts[number] for number in range(len(texts))]


def msls_val(root: Path, name: str) -> Dataset:
    """The validation part of Mapillary Street-Level Sequences (Warburg et al., CVPR 2020), without panoramas.

    Queries have a database image within 25 m, as in its own code.
    """
    lists = database, queries, selection, truth = [
        root / f"{name}_{part}.npy" for part in ("dbImages", "qImages", "qIdx", "pIdx")
    ]
    missing = [path for path in lists if not path.is_file()]
    if not missing:
        return dataset_of_lists(root, name, database, queries, truth, selection)
    if len(missing) < len(lists):
        raise InputError(f"{missing[0]}: expected beside the other lists, found nothing; get all four")
    return _dataset_of_tables(root, name)


def _dataset_of_tables(root: Path, name: str) -> Dataset:
    sides = []
    for side in ("database", "query"):
        images = [image for city in CITIES for image in _images(root / "train_val" / city / side, root)]
        xy = np.array([position for _, position in images], np.float64).reshape(-1, 2)
        sides.append(([image_name for image_name, _ in images], xy))
    (database, database_xy), (queries, query_xy) = sides
    rows = [row for row, near in enumerate(rows_within(query_xy, database_xy, REACH)) if len(near)]
    images = listed_images(root, database, root / "train_val")
    sequence = listed_images(root, [queries[row] for row in rows], root / "train_val")
    return Dataset(name, images, (QuerySequence(name, sequence, RadiusTruth(query_xy[rows], database_xy)),))


def _images(folder: Path, root: Path) -> Iterator[tuple[str, tuple[float, float]]]:
    """Name and position of the images of the task "all", without panoramas."""
    raw, processed, tasks = (_table(folder / f"{name}.csv") for name in TABLES)
    if not raw.keys() == processed.keys() == tasks.keys():
        raise InputError(f"{folder}: expected the same keys in {', '.join(f'{name}.csv' for name in TABLES)}, got "
                         f"{len(raw)}, {len(processed)} and {len(tasks)} keys with differences; get them "
                         "again")  # fmt: skip
    for key, line in processed.items():
        try:
            if _FLAGS[raw[key]["pano"].strip().lower()] or not _FLAGS[tasks[key]["all"].strip().lower()]:
                continue
            position = parse_number(line["easting"]), parse_number(line["northing"])
            if not all(abs(meters) <= FARTHEST for meters in position):  # NaN neither
                raise ValueError
            yield f"{(folder / 'images').relative_to(root).as_posix()}/{key}.jpg", position
        except (AttributeError, KeyError, TypeError, ValueError):  # missing cells are None
            raise InputError(
                f"{folder}: key {key[:60]!r}: expected pano in raw.csv and all in subtask_index.csv (True or False), "
                "easting and northing in postprocessed.csv (meters); get them again"
            ) from None


def _table(path: Path) -> dict[str, dict[str, str]]:
    """Lines of a table by key."""
    with reading(path, "a table", "get it again"), path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    table = {line.get("key") or "": line for line in lines}
    if len(table) < len(lines) or "" in table:
        raise InputError(f"{path}: expected a different key in every line, got {len(table)} in {len(lines)} lines; get "
                         "the table again")  # fmt: skip
    return table
