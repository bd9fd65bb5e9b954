"""Files of a cache: `<name>-<recipe>/ab/cdef....npz`, one for each key, written once and never changed.

A file gets its name when all of it is on disk, so a process may be killed at any moment, and any number of processes
may read and write: those that need the same file make it twice, with the same content. Its arrays have checksums.
`recipe.json` in the folder lists everything that the content depends on. Matches have one file for each query.
"""

import errno
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mfvpr.core.types import Matches
from mfvpr.matchers.match_set import QueryMatches
from mfvpr.storage.packing import pack_arrays, pack_matches, unpack_arrays, unpack_matches
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import replacing, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.runtime import ordered_map

THREADS = 4  # that read and write

Item = TypeVar("Item")
Arrays = Mapping[str, np.ndarray]


class CacheFiles(Generic[Item]):
    """Items by key in the folder of one recipe, with the methods that a cache uses of a dictionary.

    Attributes:
        folder: absolute path; it is made when the first item is written.
    """

    def __init__(
        self,
        root: Path,
        name: str,
        recipe: Mapping[str, Any],
        pack: Callable[[Item], Arrays],
        unpack: Callable[[Arrays], Item],
        *,
        compress: bool = False,
    ) -> None:
        """Name the folder below `root` by a name and a recipe (JSON values); `pack` and `unpack` convert an item."""
        self._recipe = {"format": "mfvpr cache 2", "recipe": recipe}
        name = re.sub(r"[^A-Za-z0-9._-]", "_", name)[:100]
        self.folder = root.absolute() / f"{name}-{fingerprint(self._recipe)}"
        self._pack, self._unpack, self._compress = pack, unpack, compress

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

    def update(self, items: Mapping[str, Item], *, once: bool = False) -> None:
        """Write items by key; when this returns they are on disk. If `once`, files that exist stay.

        An InputError if the disk is full or cannot be written; files that were written before stay.
        """
        packed = {key: self._pack(item) for key, item in items.items()}  # raises before anything is written

        def write(key: str) -> None:
            with replacing(self.path(key), once=once) as temporary, temporary.open("wb") as file:
                file.write(pack_arrays(packed[key], compress=self._compress))
                file.flush()
                os.fsync(file.fileno())

        with disk_errors_as_input_errors(self.folder):
            if packed and not (self.folder / "recipe.json").exists():
                write_text(self.folder / "recipe.json", json.dumps(self._recipe, indent=1, sort_keys=True) + "\n")
            for _ in ordered_map(write, packed, workers=THREADS):
                pass


class MatchStore(CacheFiles[QueryMatches]):
    """Matches of `num_queries` queries by row, of a recipe that determines database, queries, shortlist and matcher."""

    def __init__(self, root: Path, recipe: Mapping[str, Any], num_queries: int) -> None:
        # Compressed, since every candidate repeats points of the query: a match takes about 23 bytes instead of 32.
        super().__init__(root, "matches", recipe, pack_matches, unpack_matches, compress=True)
        self.num_queries = num_queries

    def has_all(self, rows: Iterable[int]) -> bool:
        """Whether there are files of all rows."""
        return all(_key(row) in self for row in rows)

    def read(self, rows: Iterable[int]) -> Iterator[tuple[int, QueryMatches | None]]:
        """(row, matches) in the order of rows; None if there is no file, or a damaged one."""
        rows = list(rows)
        yield from zip(rows, ordered_map(lambda row: self.get(_key(row)), rows, workers=THREADS), strict=True)

    def write(self, queries: Mapping[int, QueryMatches]) -> None:
        """Write matches by row; see `CacheFiles.update`."""
        self.update({_key(row): query for row, query in queries.items()})


class StoredMatches(Sequence[Matches]):
    """Matches of queries of a store, as in QueryMatches: every access reads them."""

    def __init__(self, store: MatchStore, rows: Sequence[int]) -> None:
        self._store, self._rows = store, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, query: Any) -> Matches:
        """Matches of one query; slices are not supported."""
        return next(self._read([self._rows[query]]))

    def __iter__(self) -> Iterator[Matches]:
        return self._read(self._rows)

    def _read(self, rows: Sequence[int]) -> Iterator[Matches]:
        for row, query in self._store.read(rows):
            if query is None:
                raise InputError(f"{self._store.folder}: matches of row {row} were removed or damaged; run again")
            yield query.matches


def _key(row: int) -> str:
    return f"{row % 100:02d}{row:06d}"


@contextmanager
def disk_errors_as_input_errors(folder: Path) -> Iterator[None]:
    """Raise errors of the file system as an InputError of one line."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise full_disk_error(folder) from None
        reason = f"{folder}: cannot be used ({error.strerror}); check the path, its permissions and its disk"
        raise InputError(reason) from None


def full_disk_error(folder: Path) -> InputError:
    """The error of a full disk, on which everything that was written before stays."""
    return InputError(f"{folder}: the disk is full; free some space and run again, which goes on from here")
