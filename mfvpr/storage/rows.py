"""Rows of arrays on disk, written once and read often: the common part of all stores.

A store is a folder with a manifest, which holds the recipe of the rows, and one file for each row that is done:
`<row>-<entries>.npz` (`mfvpr.utils.arrays`). A file appears when all of it is on disk, so a process may be killed at
any moment, and the next one goes on. A file knows its store and its row: exchanged files are noticed like damaged ones.

A store by key is shared by many lists of rows: the key of a row (of an image: a hash of its content) stands in its
file's name instead of the number, below a folder with the key's first two characters.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np
from jaxtyping import Bool

from mfvpr.storage.disk import disk_errors_as_input_errors, free_disk_bytes, full_disk_error, lock_store
from mfvpr.storage.manifest import Kind, check_folder, has_manifest, manifest_of, remove_store_leftovers, write_manifest
from mfvpr.utils.arrays import read_arrays, write_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.fingerprints import difference
from mfvpr.utils.threads import ordered_map

THREADS = 4  # that read ahead, or write the rows of a batch
BLOCK = 4096  # bytes that a file system hands out at a time
ARRAY_OVERHEAD = 400  # bytes at most that an array takes in its file beside its values
_FILE = re.compile(r"(0|[1-9]\d{0,8}|[0-9a-f]{32})-(0|[1-9]\d{0,8})\.npz")  # the name of the file of a row

Item = TypeVar("Item")
Parts = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class RowFormat(Generic[Item]):
    """Content of a row: the first of the packed arrays has a value for each of the row's entries."""

    kind: Kind
    pack: Callable[[Item], Parts]
    unpack: Callable[[Parts], Item]


class RowStore(Generic[Item]):
    """A store in a folder, which may be missing until the first row is written.

    Any process may read it, also while another one writes. Rows are written `with store:`, which locks a store that is
    not complete.

    Attributes:
        folder: absolute path.
        kind: of its content.
        sizes: lengths of axes by name, first M, the number of rows.
        is_writable: whether rows may be written.
        counts: `[M]` int32 entries of each row, -1 = not done, when the store was last opened, entered or looked at.
    """

    def __init__(
        self,
        folder: Path,
        form: RowFormat[Item],
        recipe: Mapping[str, Any],
        sizes: Mapping[str, int],
        *,
        keys: Sequence[str] | None = None,
        tokens: np.ndarray | None = None,
        lock: Callable[[Path, str], AbstractContextManager[None]] = lock_store,
    ) -> None:
        """Open the store, and find the rows that are done; an InputError if it was made from something else.

        Args:
            recipe: of the rows (JSON values only). Kept in plain text.
            sizes: see above; a store by key has no other.
            keys: `[M]` of the rows, 32 hexadecimal digits each; rows with the same key are one. None = rows by number.
            tokens: `[M]` a number of each row that its file knows as well: a file of the same name that was written
                with another number is a damaged one. None = names alone tell rows apart.
            lock: of the folder while rows are written, with the content for messages.
        """
        self.folder = folder.absolute()  # the working directory may change
        self.kind, self.sizes, self.is_writable = form.kind, sizes, False
        self._manifest = manifest_of(form.kind, recipe, sizes if keys is None else {})
        self._form, self._tokens, self._lock = form, tokens, lock
        self._keys = keys
        self._layout: dict[str, str] | None = None
        self._blocks: list[ExitStack] = []  # that are entered
        with disk_errors_as_input_errors(self.folder, self.kind.content):
            check_folder(self.folder, self.kind)
        self.look()

    def __enter__(self) -> Self:
        """Lock the store, unless all rows are done, and find the rows that were written meanwhile."""
        with ExitStack() as stack, disk_errors_as_input_errors(self.folder, self.kind.content):
            if not self._blocks:
                self.look()
            if not self.is_writable and not self.done.all():
                self.folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(self._lock(self.folder, self.kind.content))
                for folder in {self.folder, *self._folders}:
                    remove_store_leftovers(folder)
                write_manifest(self.folder, self.kind, self._manifest)
                self.look()
                stack.callback(setattr, self, "is_writable", False)
                self.is_writable = True
            self._blocks.append(stack.pop_all())
        return self

    def __exit__(self, *_: object) -> None:
        self._blocks.pop().close()

    def __getstate__(self) -> dict[str, Any]:
        """The state for workers of a cluster, which write while this process holds the lock."""
        return self.__dict__ | {"_lock": None, "_blocks": []}

    def look(self) -> None:
        """Find the rows that are done by now; raises `InputError` if they were made from something else."""
        entries: dict[str, int] = {}
        with disk_errors_as_input_errors(self.folder, self.kind.content):
            exists = has_manifest(self.folder, self.kind, self._manifest)
            for folder in filter(Path.is_dir, self._folders if exists else ()):
                matches = filter(None, map(_FILE.fullmatch, os.listdir(folder)))
                entries |= {match[1]: int(match[2]) for match in matches}
        names = map(str, range(next(iter(self.sizes.values())))) if self._keys is None else self._keys
        self.counts = np.fromiter((entries.get(name, -1) for name in names), np.int32)

    @property
    def _folders(self) -> list[Path]:
        """Folders with files of rows."""
        if self._keys is None:
            return [self.folder]
        return [self.folder / start for start in sorted({key[:2] for key in self._keys})]

    @property
    def done(self) -> Bool[np.ndarray, " rows"]:
        """Which rows are on disk."""
        return self.counts >= 0

    @property
    def size_bytes(self) -> int:
        """Bytes that the rows take on disk, except those that another process removes meanwhile."""
        total = 0
        for path in {self._path(row) for row in np.flatnonzero(self.done).tolist()}:
            with suppress(FileNotFoundError):
                total += path.stat().st_blocks * 512
        return total

    def write(self, items: Mapping[int, Item]) -> None:
        """Store a batch of items by row. When this returns they are done, and on disk.

        If the disk is full or cannot be written, an InputError is raised, and rows done before stay intact.
        """
        if items:
            self.write_parts(self.pack(items))

    def pack(self, items: Mapping[int, Item]) -> dict[int, Parts]:
        """Check a batch of rows and pack it for `write_parts`, without a write."""
        if refused := [row for row in items if not 0 <= row < len(self.counts) or self.counts[row] >= 0]:
            raise ValueError(f"{self.folder}: row {refused[0]} is done or does not exist")
        if not self.is_writable:
            raise ValueError(f"{self.folder}: is read only, or was complete; write `with store:`")
        rows: dict[int, Parts] = {}
        for row, item in items.items():
            try:
                rows[row] = self._form.pack(item)
            except ValueError as error:
                raise ValueError(f"{self.folder}: row {row}: {error}") from None
        self._check_layouts(rows)
        return rows

    def write_parts(self, rows: Mapping[int, Parts]) -> None:
        """Store the result of `pack`, as `write` does."""
        sizes = {row: row_bytes(sum(part.nbytes for part in parts.values()), len(parts)) for row, parts in rows.items()}
        with disk_errors_as_input_errors(
            self.folder, self.kind.content, lambda: sum(size for row, size in sizes.items() if self.counts[row] < 0)
        ):
            for _ in ordered_map(self._write_row, rows.items(), workers=THREADS):
                pass

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, Item]]:
        """(row, item) of rows that are done, by default of all; threads read ahead.

        If rows are damaged, all rows are read before the InputError is raised, but none is yielded after the first
        damaged one. Damaged rows are removed if a run can make them again.
        """
        rows = np.flatnonzero(self.done).tolist() if rows is None else list(rows)
        if missing := [row for row in rows if self.counts[row] < 0]:
            raise ValueError(f"{self.folder}: row {missing[0]} is not done")
        damaged: dict[int, Path] = {}
        for row, item in zip(rows, ordered_map(self._read_item, rows, workers=THREADS), strict=True):
            if item is None:
                damaged[row] = self._path(row)
            elif not damaged:
                yield row, item
        if damaged:
            raise InputError(self._remove(damaged))

    def _path(self, row: int) -> Path:
        """The file of a row that is done."""
        return self._file(row, self.counts[row])

    def _file(self, row: int, count: int) -> Path:
        if self._keys is None:
            return self.folder / f"{row}-{count}.npz"
        return self.folder / self._keys[row][:2] / f"{self._keys[row]}-{count}.npz"

    def _about(self, row: int, path: Path) -> str:
        token = "" if self._tokens is None else f" {self._tokens[row]:x}"
        return f"{self._manifest['fingerprint']} {path.name}{token}"

    def _write_row(self, row_parts: tuple[int, Parts]) -> None:
        row, parts = row_parts
        count = len(next(iter(parts.values())))
        path = self._file(row, count)
        path.parent.mkdir(exist_ok=True)
        write_arrays(path, parts, self._about(row, path), compress=self.kind.compress)
        self.counts[row] = count

    def _read_item(self, row: int) -> Item | None:
        parts = self._read_parts(row)
        return None if parts is None else self._form.unpack(parts)

    def _read_parts(self, row: int) -> Parts | None:
        """Arrays by name; None if the file is damaged, or of another row, or gone."""
        path = self._path(row)
        with disk_errors_as_input_errors(self.folder, self.kind.content):
            try:
                return read_arrays(path, self._about(row, path))
            except (InputError, FileNotFoundError):
                return None

    def _check_layouts(self, rows: Mapping[int, Parts]) -> None:
        """Refuse rows whose arrays differ from the other rows: they could not be put together."""
        stored = filter(None, map(self._read_parts, np.flatnonzero(self.done).tolist()))  # none is read yet
        layout = self._layout or _layout_of(next(stored, next(iter(rows.values()))))
        for row, parts in rows.items():
            if differs := difference(_layout_of(parts), layout):
                advice = self.kind.advice("describe all of them alike")
                raise InputError(f"{self.folder}: row {row}: {differs} as in the other {self.kind.rows}; {advice}")
        self._layout = layout

    def _remove(self, damaged: Mapping[int, Path]) -> str:
        """Remove damaged rows if a run can make them again; returns the message."""
        row, path = next(iter(damaged.items()))
        if self.kind.remake is None:
            mend = "put back the files that were written here, or delete these to leave the rows out"
        else:
            self.counts[list(damaged)] = -1
            mend = f"run again, which {self.kind.remake} them anew"
            for file in damaged.values():
                with suppress(OSError):
                    file.unlink(missing_ok=True)
            if any(file.exists() for file in damaged.values()):
                mend = f"they cannot be removed; make the folder writable and {mend}"
        return (
            f"{self.folder}: {self.kind.content} of {len(damaged)} {self.kind.rows} are damaged on disk, the first in "
            f"row {row} ({path.name}); {mend}"
        )


def row_bytes(num_bytes: float, num_arrays: int) -> int:
    """Bytes on disk, at most, of a row with values of `num_bytes`."""
    return -(-int(num_bytes + num_arrays * ARRAY_OVERHEAD) // BLOCK) * BLOCK


def require_space(folder: Path, num_bytes: int) -> None:
    """Raise `InputError` if less than `num_bytes` are free on the disk of `folder`."""
    if free_disk_bytes(folder) < num_bytes:
        raise full_disk_error(folder, num_bytes)


def _layout_of(parts: Parts) -> dict[str, str]:
    """Names, types and all but the first lengths of arrays: they are the same in all rows."""
    return {name: f"{part.dtype}{list(part.shape[1:])}" for name, part in parts.items()}
