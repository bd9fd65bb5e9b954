"""Files of a cache: `<name>-<recipe>/ab/cdef....npz`, one for each key, written once and never changed.

A file gets its name when all of it is on disk, so a process may be killed at any moment, and any number of processes
may read and write: those that need the same file make it twice, with the same content. Its arrays have checksums.
`recipe.json` in the folder lists everything that the content depends on. Matches have one file for each query.

Features: `keypoints` float32 `[N, 2]` (px), `descriptors` float16 `[N, D]` of unit length but for rounding, `scales`
float32 `[N]` that restore their lengths, `scores` float32 `[N]` and `image_size` float32 `[2]` (px), without padding.
They are read as float32: the directions of descriptors change by up to 5e-4, everything else is unchanged.

Matches of a query with its candidates: the fields of QueryMatches and of its Matches by name, except fields that are
None. They come back to the bit.
"""

import errno
import io
import json
import os
import re
import sqlite3
import struct
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mfvpr.core.types import Features, Matches
from mfvpr.matchers.match_set import QueryMatches
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.runtime import ordered_map

THREADS = 4  # that read and write
_OF_QUERY = ("counts", "indices", "filter_scores")
_OF_MATCHES = tuple(part.name for part in fields(Matches) if part.name != "mask")  # there is no padding
# NumPy reads the headers of arrays by `ast.parse`, which sometimes fails when several threads call it at the same time
# (SystemError: AST constructor recursion depth mismatch; Python 3.11).
_PARSING = threading.Lock()

Item = TypeVar("Item")
Arrays = Mapping[str, np.ndarray]


class CacheFiles(Generic[Item]):
    """Items by key in the folder of one recipe, with the methods that a cache uses of a dictionary."""

    compress = False

    def __init__(
        self, root: Path, name: str, recipe: Mapping, pack: Callable[[Item], Arrays], unpack: Callable[[Arrays], Item]
    ) -> None:
        """Name the folder below `root` by a name and a recipe (JSON values); `pack` and `unpack` convert an item."""
        self._recipe = {"format": "mfvpr cache 2", "recipe": recipe}
        name = re.sub(r"[^A-Za-z0-9._-]", "_", name)[:100]
        self.folder = root.absolute() / f"{name}-{fingerprint(self._recipe)}"
        self._pack, self._unpack = pack, unpack

    def path(self, key: str) -> Path:
        """The file of a key."""
        return self.folder / key[:2] / f"{key[2:]}.npz"

    def __contains__(self, key: str) -> bool:
        return self.path(key).exists()

    def get(self, key: str) -> Item | None:
        """The item of a key; None if there is no file, or one that is damaged (`in` tells them apart)."""
        with disk_errors_as_input_errors(self.folder):
            try:
                return self._unpack(unpack_arrays(self.path(key).read_bytes()))
            except (FileNotFoundError, InputError):
                return None

    def update(self, items: Mapping[str, Item]) -> None:
        """Write items by key; when this returns they are on disk.

        An InputError if the disk is full or cannot be written; files that were written before stay.
        """
        packed = {key: self._pack(item) for key, item in items.items()}  # raises before anything is written

        def write(key: str) -> None:
            with replacing(self.path(key)) as temporary, temporary.open("wb") as file:
                file.write(pack_arrays(packed[key], compress=self.compress))
                file.flush()
                os.fsync(file.fileno())

        with disk_errors_as_input_errors(self.folder):
            if packed and not (self.folder / "recipe.json").exists():
                write_text(self.folder / "recipe.json", json.dumps(self._recipe, indent=1, sort_keys=True) + "\n")
            for _ in ordered_map(write, packed, workers=THREADS):
                pass


class MatchStore(CacheFiles[QueryMatches], Sequence[Matches]):
    """Matches of queries by row, of a recipe that determines database, queries, shortlist and matcher.

    As a sequence, every access reads the Matches of a query, as in QueryMatches; slices are not supported.
    """

    compress = True  # every candidate repeats points of the query: a match takes about 23 bytes instead of 32

    def __init__(self, root: Path, recipe: Mapping[str, Any], num_queries: int) -> None:
        super().__init__(root, "matches", recipe, pack_matches, unpack_matches)
        self._rows = range(num_queries)

    @property
    def is_complete(self) -> bool:
        """Whether there are files of all queries."""
        return all(_key(row) in self for row in self._rows)

    def read(self) -> Iterator[QueryMatches | None]:
        """Matches in the order of rows; None if there is no file, or a damaged one."""
        return ordered_map(self.get, map(_key, self._rows), workers=THREADS)

    def write(self, queries: Mapping[int, QueryMatches]) -> None:
        """Write matches by row; see `CacheFiles.update`."""
        self.update({_key(row): query for row, query in queries.items()})

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, row: Any) -> Matches:
        return self._matches(self.get(_key(self._rows[row])))

    def __iter__(self) -> Iterator[Matches]:
        return map(self._matches, self.read())

    def _matches(self, query: QueryMatches | None) -> Matches:
        if query is None:
            raise InputError(f"{self.folder}: matches were removed or damaged meanwhile; run again")
        return query.matches


def _key(row: int) -> str:
    return f"{row % 100:02d}{row:06d}"


@contextmanager
def disk_errors_as_input_errors(place: Path) -> Iterator[None]:
    """Raise errors of the file system and of SQLite as an InputError of one line."""
    try:
        yield
        return
    except OSError as error:
        is_full, got = error.errno in (errno.ENOSPC, errno.EDQUOT), error.strerror
    except sqlite3.Error as error:
        is_full, got = getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_FULL, error
    if is_full:
        raise InputError(f"{place}: the disk is full; free some space and run again, which goes on from here")
    raise InputError(f"{place}: cannot be used ({got}); check the path, its permissions and its disk")


def pack_arrays(arrays: Arrays, *, compress: bool = False) -> bytes:
    """The content of an `.npz` file, which `numpy.load` reads as well; `compress` is for repeated values."""
    buffer = io.BytesIO()
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def unpack_arrays(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of `pack_arrays`; an `InputError` if they are damaged: the archive has a checksum of each."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.namelist():
                values = archive.read(member)
                start = 10 + int.from_bytes(values[8:10], "little")  # of the values, in the format's version 1
                shape, is_fortran, dtype = _header(values[:start])
                array = np.frombuffer(values, dtype, offset=start).reshape(shape, order="F" if is_fortran else "C")
                arrays[member.removesuffix(".npy")] = array.copy()  # that may be written to
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError, ValueError):
        raise InputError("expected arrays as they were written here, got damaged ones") from None
    return arrays


@lru_cache(256)
def _header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The header of an array, cached: the files of a cache have few different ones, and NumPy reads them slowly."""
    with _PARSING:
        return np.lib.format.read_array_header_1_0(io.BytesIO(header[8:]))


def pack_features(features: Features) -> dict[str, np.ndarray]:
    """Arrays of the features `[N, ...]` of an image; a ValueError if they are not finite."""
    mask = np.asarray(features.mask)
    keypoints, descriptors, scores = (
        np.asarray(values, np.float32)[mask] for values in (features.keypoints, features.descriptors, features.scores)
    )
    lengths = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.float64)).astype(np.float32)
    image_size = np.asarray(features.image_size, np.float32)
    if not all(np.isfinite(part).all() for part in (keypoints, lengths, scores, image_size)):
        raise ValueError("features must be finite")
    directions = (descriptors / np.where(lengths > 0, lengths, 1)[:, None]).astype(np.float16)
    norms = np.sqrt(np.einsum("nd,nd->n", directions, directions, dtype=np.float32))
    scales = lengths / np.where(norms > 0, norms, 1)
    return dict(keypoints=keypoints, descriptors=directions, scales=scales, scores=scores, image_size=image_size)


def unpack_features(arrays: Arrays) -> Features:
    """The features of `pack_features`."""
    descriptors = arrays["descriptors"].astype(np.float32)
    descriptors *= arrays["scales"][:, None]
    mask = np.ones(len(descriptors), bool)
    return Features(arrays["keypoints"], descriptors, arrays["scores"], mask, arrays["image_size"])


def round_as_stored(features: Features) -> Features:
    """Features `[N, ...]` as they come back from a file: without padding, descriptors to 5e-4."""
    return unpack_features(pack_features(features))


def pack_matches(query: QueryMatches) -> dict[str, np.ndarray]:
    """Arrays of the matches of a query."""
    arrays = {name: getattr(query.matches, name) for name in _OF_MATCHES}
    arrays |= {name: getattr(query, name) for name in _OF_QUERY}
    return {name: np.asarray(values) for name, values in arrays.items() if values is not None}


def unpack_matches(arrays: Arrays) -> QueryMatches:
    """The matches of `pack_matches`."""
    of_matches = {name: values for name, values in arrays.items() if name in _OF_MATCHES}
    matches = Matches(mask=np.ones(len(arrays["points0"]), bool), **of_matches)
    return QueryMatches(matches, *(arrays[name] for name in _OF_QUERY))
