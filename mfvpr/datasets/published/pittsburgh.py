"""Pittsburgh30k (Torii et al., CVPR 2013; Arandjelovic et al., CVPR 2016): street views by their position."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.ground_truth import FrameTruth, RadiusTruth
from mfvpr.datasets.published.lists import expected_file, listed_images, read_names, read_rows
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.utils.errors import InputError

LAYOUT = """000/*.jpg, ..., queries_real/000/*.jpg, ...
datasets/pitts30k_{part}.mat                                 lists and positions; or, as GSV-Cities has them,
pitts30k_{part}_dbImages.npy, _qImages.npy, _gt.npy (_gt_25m.npy)"""
QUERIES = "queries_real"
_DAMAGE = (ArithmeticError, LookupError, TypeError, ValueError, EOFError, StopIteration)


def pitts30k(root: Path, name: str) -> Dataset:
    """The part `name` ends in, val or test: right within a radius of the query, or by the lists' own 25 m.

    Raises:
        InputError: lists or images are missing or damaged.
    """
    structure = f"{name}.mat"
    if path := expected_file(root, f"datasets/{structure}", structure):
        return _of_structure(root, name, path)
    lists = [expected_file(root, f"{name}_{part}.npy") for part in ("dbImages", "qImages", "gt_25m", "gt")]
    database, queries, *truths = lists
    if database is None or queries is None or not any(truths):
        raise InputError(f"{root}: expected datasets/{structure}, or {name}_dbImages.npy, {name}_qImages.npy and "
                         f"{name}_gt.npy, found neither; get the whole data set")  # fmt: skip
    return listed_dataset(root, name, database, queries, next(filter(None, truths)))


def listed_dataset(root: Path, name: str, database_list: Path, query_list: Path, truth_list: Path) -> Dataset:
    """Of NumPy's lists, as GSV-Cities and OpenVPRLab have them: names, and which database images are right."""
    database = listed_images(root, read_names(database_list), database_list)
    queries = listed_images(root, read_names(query_list), query_list)
    rows = read_rows(truth_list, len(database))
    if len(rows) != len(queries):
        raise InputError(f"{truth_list}: expected rows of {len(queries)} queries, got {len(rows)}")
    truth = FrameTruth(tuple(rows), len(database), widened=False)
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _of_structure(root: Path, name: str, path: Path) -> Dataset:
    try:
        with path.open("rb") as file:
            found = read_matlab(file, text=True)
        names = [_texts(found, f"dbStruct.{field}.") for field in ("dbImageFns", "qImageFns")]
        positions = [found[f"dbStruct.{field}"].T.astype(np.float64) for field in ("utmDb", "utmQ")]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except _DAMAGE:
        raise InputError(f"{path}: expected the structure dbStruct of {name}; get the file again") from None
    for some, places in zip(names, positions, strict=True):
        if places.shape != (len(some), 2) or not np.isfinite(places).all():
            raise InputError(f"{path}: expected a position for each of {len(some)} images, got {list(places.shape)}")
    database = listed_images(root, names[0], path)
    queries = listed_images(root, [f"{QUERIES}/{one}" for one in names[1]], path)
    truth = RadiusTruth(positions[1], positions[0])
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _texts(found: dict[str, np.ndarray], prefix: str) -> Sequence[str]:
    """Of a cell, in order."""
    places = {int(path.removeprefix(prefix)): str(text) for path, text in found.items() if path.startswith(prefix)}
    return [places[place] for place in range(len(places))]
