"""Read and write hloc's HDF5 files: a group for each image, named by its relative path, a dataset for each array."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.io.containers import MAX_INFLATED, Container, Shapes, reading, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_replaceable


class H5File(Container):
    """Reader of an hloc file, which is open only during a call. Images are the groups that hold datasets."""

    transposed = True

    def __init__(self, path: Path) -> None:
        self.path = path
        names: list[str] = []
        with _open(path) as file:
            file.visit(names.append)  # follows no links
        groups = {name.rpartition("/")[0] for name in names}
        images = (name.rpartition("/")[0] for name in names if name not in groups)
        self.images = tuple(dict.fromkeys(filter(None, images)))
        if not self.images:
            raise InputError(f"{path}: expected a group for every image, as hloc writes them, got no datasets")

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        with _open(self.path) as file:
            for image in images:
                group = file[image]
                yield {name: self._dataset(group, image, name).shape if name in parts else () for name in group}

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        with _open(self.path) as file:
            for image in images:
                group = file[image]
                yield {part: self._dataset(group, image, part)[()] for part in parts if part in group}

    def _dataset(self, group: Any, image: str, part: str) -> Any:
        """The dataset of a group; an InputError unless its values are in this file."""
        h5py = _h5py(self.path)
        where = f"{self.path}: {shorten(image)}/{part}"
        dataset: Any = group[part] if isinstance(group.get(part, getlink=True), h5py.HardLink) else None
        if not isinstance(dataset, h5py.Dataset) or dataset.shape is None or dataset.external or dataset.is_virtual:
            raise InputError(f"{where}: expected data in this file, got a group or a link; copy the data")
        stored = dataset.id.get_storage_size()
        if dataset.size and not stored:  # HDF5 would read zeros
            raise InputError(f"{where}: expected data, got a dataset that was not written; extract this image again")
        if dataset.nbytes > max(MAX_INFLATED, stored):
            raise InputError(f"{where}: expected at most 1 GiB in a compressed dataset; write it uncompressed")
        return dataset


def write_h5(path: Path, groups: Iterable[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """Write a new file with a group for each image, one after the other, atomically; `libver` as in hloc."""
    require_replaceable(path)
    with replacing(path) as temporary, _h5py(path).File(temporary, "w", libver="latest") as file:
        for image, parts in groups:
            group = file.create_group(printable(image))
            for part, array in parts.items():
                group.create_dataset(part, data=array)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    with reading(path), _h5py(path).File(path, "r") as file:
        yield file


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: HDF5 needs the package h5py; pip install 'mfvpr[hloc]'") from None
    return h5py
