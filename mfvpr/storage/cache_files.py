"""Files of a cache: `<name>-<recipe>/ab/cdef....npz`, one for each key, written once and never changed.

A file gets its name when all of it is on disk, so a process may be killed at any moment, and any number of processes
may read and write: those that need the same file make it twice, with the same content. A file knows its recipe and its
key, and has a checksum. `recipe.json` in the folder lists everything that the content depends on.
"""

import errno
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import remove_leftovers, write_text
from mfvpr.utils.fingerprints import fingerprint
from mfvpr.utils.threads import ordered_map

FORMAT = "mfvpr cache 1"  # of the files and folders
THREADS = 4  # that write
_LEFTOVER = 24 * 3600  # seconds: temporary files that are older were left by killed processes

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
        self._recipe = {"format": FORMAT, "recipe": recipe}
        self._fingerprint = fingerprint(self._recipe)
        self.folder = root.absolute() / f"{re.sub(r'[^A-Za-z0-9._-]', '_', name)[:100]}-{self._fingerprint}"
        self._pack, self._unpack, self._compress = pack, unpack, compress
        self._is_open = False  # whether something was written

    def path(self, key: str) -> Path:
        """The file of a key."""
        return self.folder / key[:2] / f"{key[2:]}.npz"

    def __contains__(self, key: str) -> bool:
        return self.path(key).exists()

    def get(self, key: str) -> Item | None:
        """The item of a key; None if there is no file, or one that is damaged (`in` tells them apart)."""
        with disk_errors_as_input_errors(self.folder):
            try:
                return self._unpack(read_arrays(self.path(key), self._about(key)))
            except (FileNotFoundError, InputError):
                return None

    def update(self, items: Mapping[str, Item], *, once: bool = False) -> None:
        """Write items by key; when this returns they are on disk. If `once`, files that exist stay.

        An InputError if the disk is full or cannot be written; files that were written before stay.
        """
        packed = {key: self._pack(item) for key, item in items.items()}  # raises before anything is written

        def write(key: str) -> None:
            options = {"compress": self._compress, "once": once}
            write_arrays(self.path(key), packed[key], self._about(key), **options)

        with disk_errors_as_input_errors(self.folder):
            if packed and not self._is_open:
                if not (self.folder / "recipe.json").exists():
                    write_text(self.folder / "recipe.json", json.dumps(self._recipe, indent=1, sort_keys=True) + "\n")
                remove_leftovers(self.folder, seconds=_LEFTOVER)
                self._is_open = True
            for _ in ordered_map(write, packed, workers=THREADS):
                pass

    def _about(self, key: str) -> str:
        return f"{self._fingerprint} {key}"


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
