"""Read and write hloc's HDF5 files: a group for each image, named by its relative path, a dataset for each array.

The reader follows no links and reads no storage in other files.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mfvpr.io.containers import MAX_INFLATED, Container, Shapes, reading, require_plain, shorten
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import printable, replacing, require_replaceable


class H5File(Container):
    """Reader of an hloc file, which is open only during a call."""

    transposed = True

    def __init__(self, path: Path) -> None:
        h5py = _h5py(path)
        self.path = path
        with reading(path), h5py.File(path, "r") as file:
            self.images = tuple(_images(path, file))
        if not self.images:
            raise InputError(f"{path}: expected a group for every image, as hloc writes them, got no datasets")

    def shapes(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Shapes]:
        h5py = _h5py(self.path)
        with reading(self.path), h5py.File(self.path, "r") as file:
            for image in images:  # with the low-level interface, which is five times faster
                group = h5py.h5g.open(file.id, _encode(image))
                names = {name.decode("utf-8", "surrogateescape") for name in group}
                yield {
                    name: _open_dataset(self.path, image, group, name).shape if name in parts else () for name in names
                }

    def arrays(self, images: Iterable[str], parts: Sequence[str]) -> Iterator[Mapping[str, np.ndarray]]:
        h5py = _h5py(self.path)
        with reading(self.path), h5py.File(self.path, "r") as file:
            for image in images:
                name = _encode(image)
                _require_data(self.path, file.id, name, name)
                group = h5py.h5g.open(file.id, name)
                yield {part: _read(self.path, image, group, part) for part in parts if _encode(part) in group}


class H5Pairs(H5File):
    """Reader of an hloc file of matches, with the names `IMAGE/IMAGE` of all pairs; it opens no pair."""

    def __init__(self, path: Path) -> None:
        h5py = _h5py(path)
        self.path, names = path, list[str]()
        with reading(path), h5py.File(path, "r") as file:
            for name in file.id:
                _require_data(path, file.id, name, name)
                if h5py.h5o.get_info(file.id, name).type == h5py.h5o.TYPE_GROUP:
                    names += [b"/".join((name, child)).decode("utf-8", "surrogateescape")
                              for child in h5py.h5g.open(file.id, name)]  # fmt: skip
        self.images = tuple(names)


def write_h5(path: Path, groups: Iterable[tuple[str, Mapping[str, np.ndarray]]]) -> None:
    """Write a new file with a group for each image, one after the other, atomically; `libver` as in hloc."""
    h5py = _h5py(path)
    require_replaceable(path)
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
    """Names of the groups that hold datasets; groups below them are ignored."""
    h5py = _h5py(path)
    addresses: set[int] = set()
    names = [b""]
    while names:
        name = names.pop()
        group = h5py.h5g.open(file.id, name) if name else file.id
        address = h5py.h5o.get_info(group).addr
        if address in addresses:  # a group that contains itself
            raise InputError(f"{path}: {_decode(name)}: expected a group with one name, got one with several; copy it")
        addresses.add(address)
        for child in group:
            where = b"/".join((name, child)) if name else child
            _require_data(path, group, child, where)
            kind = h5py.h5o.get_info(group, child).type
            if kind == h5py.h5o.TYPE_GROUP:
                names.append(where)
            elif kind == h5py.h5o.TYPE_DATASET and name:
                yield name.decode("utf-8", "surrogateescape")
                break


def _open_dataset(path: Path, image: str, group: Any, part: str) -> Any:
    name, where = _encode(part), f"{path}: {shorten(image)}/{part}"
    _require_data(path, group, name, _encode(f"{image}/{part}"))
    try:
        dataset = _h5py(path).h5d.open(group, name)
    except (KeyError, ValueError, OSError):
        raise InputError(f"{where}: expected a dataset, got a group or damaged bytes") from None
    if dataset.shape is None:
        raise InputError(f"{where}: expected values, got a dataset without any")
    return dataset


def _read(path: Path, image: str, group: Any, part: str) -> np.ndarray:
    """Read all values, which must be in this file."""
    where, dataset = f"{path}: {shorten(image)}/{part}", _h5py(path).Dataset(_open_dataset(path, image, group, part))
    require_plain(where, dataset.dtype)
    if dataset.external or dataset.is_virtual:
        raise InputError(f"{where}: expected data in this file, got storage in others, which is not read; copy it")
    if dataset.size and not _has_all_values(dataset):
        raise InputError(f"{where}: expected data, got a dataset that was not written; extract this image again")
    if dataset.nbytes > max(MAX_INFLATED, dataset.id.get_storage_size()):
        raise InputError(f"{where}: expected at most 1 GiB in a compressed dataset, got more; write it uncompressed")
    return np.asarray(dataset[()])


def _has_all_values(dataset: Any) -> bool:
    """Whether the file stores all values; HDF5 replaces missing ones by a fill value."""
    if dataset.chunks is None:
        return dataset.id.get_storage_size() > 0
    chunks = (-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    return dataset.id.get_num_chunks() == math.prod(chunks)


def _require_data(path: Path, group: Any, name: bytes, where: bytes) -> None:
    """Raise an InputError for any link: a link inside the file may lead to one that leaves it."""
    if group.links.get_info(name).type != _h5py(path).h5l.TYPE_HARD:
        raise InputError(f"{path}: {_decode(where)}: expected data, got a link, which is not followed; copy the data")


def _encode(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def _decode(name: bytes) -> str:
    return shorten(name.decode("utf-8", "surrogateescape"))
