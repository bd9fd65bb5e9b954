"""hloc's HDF5 files: a group for every image, named by its relative path, with a dataset for every array.

Only what is in the file itself is read: no links, no storage in other files.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.io.containers import Contents, FileEntry, reading, require_plain, shortened
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_file


class H5File:
    """A file that hloc wrote; it is open only while something is read."""

    transposed = True

    def __init__(self, path: Path) -> None:
        require_file(path)
        h5py = _h5py(path)
        self.path = path
        with reading(path), h5py.File(path, "r") as file:
            self.images = tuple(_images(path, file))
        if not self.images:
            raise InputError(f"{path}: expected a group for every image, as hloc writes them, got no datasets")

    def contents(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Contents]:
        h5py = _h5py(self.path)
        with reading(self.path), h5py.File(self.path, "r") as file:
            for image in images:  # by HDF5's own calls, which take a fifth of the time
                group = h5py.h5g.open(file.id, _encoded(image))
                names = {name.decode("utf-8", "surrogateescape") for name in group}
                opened = ((part, _opened(self.path, image, group, part)) for part in parts if part in names)
                yield Contents(names, {part: data.shape for part, data in opened})

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        h5py = _h5py(self.path)
        with reading(self.path), h5py.File(self.path, "r") as file:
            for image in images:
                group = h5py.h5g.open(file.id, _encoded(image))
                there = (part for part in parts if _encoded(part) in group)
                yield {part: _read(self.path, image, group, part) for part in there}

    def entry(self, image: str) -> FileEntry:
        return FileEntry(self.path, image)


def write_h5(path: Path, groups: Iterable[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """A group for every image, one after the other, atomically; `libver` as hloc has it."""
    h5py = _h5py(path)
    with replacing(path) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        for image, parts in groups:
            group = file.create_group(printable(image))
            for part, array in parts.items():
                group.create_dataset(part, data=array)


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: HDF5 needs the package h5py; pip install 'mfvpr[hloc]'") from None
    return h5py


def _images(path: Path, file: Any) -> Iterator[str]:
    """Names of the groups that hold datasets; a group with one holds no other images."""
    h5py = _h5py(path)
    seen: set[int] = set()
    waiting = [b""]
    while waiting:
        name = waiting.pop()
        group = h5py.h5g.open(file.id, name) if name else file.id
        address = h5py.h5o.get_info(group).addr
        if address in seen:  # or a group that holds itself would never end
            raise InputError(f"{path}: {_decoded(name)}: expected a group with one name, got one with several; copy it")
        seen.add(address)
        for child in group:
            where = b"/".join((name, child)) if name else child
            if not _is_hard(path, group, child):
                raise _linked(path, where)
            kind = h5py.h5o.get_info(group, child).type
            if kind == h5py.h5o.TYPE_GROUP:
                waiting.append(where)
            elif kind == h5py.h5o.TYPE_DATASET and name:
                yield name.decode("utf-8", "surrogateescape")
                break


def _opened(path: Path, image: str, group: Any, part: str) -> Any:
    """The dataset of this name, as HDF5 has it."""
    name, where = _encoded(part), f"{image}/{part}"
    if not _is_hard(path, group, name):
        raise _linked(path, _encoded(where))
    try:
        data = _h5py(path).h5d.open(group, name)
    except (KeyError, ValueError, OSError):
        raise InputError(f"{path}: {shortened(where)}: expected a dataset, got a group or damaged bytes") from None
    if data.shape is None:
        raise InputError(f"{path}: {shortened(where)}: expected values, got a dataset without any")
    return data


def _read(path: Path, image: str, group: Any, part: str) -> np.ndarray:
    """All values, which must be in this very file."""
    where, dataset = f"{path}: {shortened(image)}/{part}", _h5py(path).Dataset(_opened(path, image, group, part))
    require_plain(where, dataset.dtype)
    if dataset.external or dataset.is_virtual:
        raise InputError(
            f"{where}: expected data in this file, got storage in others, which is not read; copy the data"
        )
    if dataset.size and not _is_written(dataset):
        raise InputError(f"{where}: expected data, got a dataset that was not written; extract this image again")
    return dataset[()]


def _is_written(dataset: Any) -> bool:
    """Whether all values are in the file; HDF5 makes up those that are not."""
    if dataset.chunks is None:
        return dataset.id.get_storage_size() > 0
    chunks = (-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    return dataset.id.get_num_chunks() == math.prod(chunks)


def _is_hard(path: Path, group: Any, name: bytes) -> bool:
    return group.links.get_info(name).type == _h5py(path).h5l.TYPE_HARD


def _linked(path: Path, where: bytes) -> InputError:
    """No link is followed: one inside the file may lead to one that leaves it."""
    return InputError(f"{path}: {_decoded(where)}: expected data, got a link, which is not followed; copy the data")


def _encoded(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def _decoded(name: bytes) -> str:
    return shortened(name.decode("utf-8", "surrogateescape"))
