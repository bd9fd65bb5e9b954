"""Pittsburgh30k (Torii et al., CVPR 2013; Arandjelovic et al., CVPR 2016): street views by their position."""

from pathlib import Path

import numpy as np

from mfvpr.datasets.datasets import Dataset, QuerySequence
from mfvpr.datasets.ground_truth import RadiusTruth
from mfvpr.datasets.published.lists import dataset_of_lists, expected_file, listed_images
from mfvpr.io.containers import reading
from mfvpr.io.formats.matlab_files import read_matlab
from mfvpr.utils.errors import InputError

LAYOUT = """000/*.jpg, ..., queries_real/000/*.jpg, ...
datasets/pitts30k_{part}.mat                                 lists and positions; or, as GSV-Cities has them,
pitts30k_{part}_dbImages.npy, _qImages.npy, _gt.npy (_gt_25m.npy)"""
QUERIES = "queries_real"


def pitts30k(root: Path, name: str) -> Dataset:
    """The validation or test part; correct within a radius of the query, or within the lists' 25 m."""
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
        if xy.shape != (len(names), 2) or not np.isfinite(xy).all():
            raise InputError(f"{path}: expected a position for each of {len(names)} images, got {list(xy.shape)}")
    database = listed_images(root, sides[0], path)
    queries = listed_images(root, [f"{QUERIES}/{query}" for query in sides[1]], path)
    truth = RadiusTruth(positions[1], positions[0])
    return Dataset(name, database, (QuerySequence(name, queries, truth),))


def _cell_texts(arrays: dict[str, np.ndarray], prefix: str) -> list[str]:
    """Texts of a cell array, in order."""
    texts = {int(path.removeprefix(prefix)): str(text) for path, text in arrays.items() if path.startswith(prefix)}
    return [texts[number] for number in range(len(texts))]
