"""Rows of arrays on disk, for whoever makes them slowly and reads them often: the common part of all stores.

A store is a Zarr v3 group of arrays whose first axis is the row. Chunks belong to one row each and are compressed, with
a checksum; what a row does not fill costs nothing. Its manifest says what the rows were made from.

`count` int32 `[M]`, the entries of each row, is -1, without a chunk, until all else of a row is on disk: one small
file, which appears as a whole, says that the row is done. So a process may be killed at any moment, and the next one
goes on.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tensorstore as ts

from mfvpr.data._store_disk import (
    Column,
    commit,
    free_bytes,
    is_damage,
    locked,
    open_arrays,
    read_counts,
    reason,
    told,
    too_full,
)
from mfvpr.data.store_manifest import Kind, check_owned, settle_manifest
from mfvpr.errors import InputError

READ_AHEAD = 16  # rows
BLOCK = 4096  # bytes that a file system hands out at a time


@dataclass(eq=False)
class RowStore:
    """An open store; made by `open_rows`.

    Attributes:
        folder: where it is, absolute.
        kind: what it holds.
        counts: `[M]` int32 entries of each row, -1 = not done. To be read only.
        columns: its arrays but for `count`; empty until the first row tells them.
    """

    folder: Path
    kind: Kind
    counts: np.ndarray
    _context: ts.Context = field(repr=False)
    columns: dict[str, Column] = field(default_factory=dict, repr=False)
    _arrays: dict[str, ts.TensorStore] = field(default_factory=dict, repr=False)

    @property
    def done(self) -> np.ndarray:
        """`[M]` bool, the rows that are on disk."""
        return self.counts >= 0

    @property
    def size_bytes(self) -> int:
        """Bytes that the store takes on disk."""
        return sum(path.stat().st_blocks * 512 for path in self.folder.rglob("*"))

    def resume(self, columns: Mapping[str, Column]) -> None:
        """Go on with what is on disk; arrays that are not there are made.

        Raises:
            InputError: damaged beyond what the next run mends by itself, or the folder cannot be written.
        """
        with told(self.folder, self.kind.content):
            self._open(columns)
            self.counts[:] = read_counts(self._arrays["count"])

    def write(self, rows: Mapping[int, Mapping[str, np.ndarray]], columns: Mapping[str, Column]) -> None:
        """Store a batch of rows. When this returns they are done, and on disk.

        Args:
            rows: by row, every column's value: `[*shape]`, or `[count, *shape]` where it has entries.
            columns: what the arrays are, if they are not there yet.

        Raises:
            InputError: the disk is full, or cannot be written. Rows done before stay intact.
            ValueError: a row that is done or does not exist.
        """
        if not rows:
            return
        if refused := [row for row in rows if not 0 <= row < len(self.counts) or self.counts[row] >= 0]:
            raise ValueError(f"{self.folder}: row {refused[0]} is done or does not exist")
        entries = next(name for name, column in columns.items() if column.chunk)
        counts = {row: len(parts[entries]) for row, parts in rows.items()}
        needed = forecast_bytes(columns, int((~self.done).sum()), sum(counts.values()) / len(counts))
        with told(self.folder, self.kind.content, needed):
            if not self.columns:
                self._open(columns)
            commit([self._write_part(row, name, part) for row, parts in rows.items() for name, part in parts.items()])
            commit([self._arrays["count"][row].write(count) for row, count in counts.items()])
        self.counts[list(counts)] = list(counts.values())

    def read(self, rows: Iterable[int] | None = None) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """(row, its value by column) of rows that are done, by default of all; some are read ahead on threads.

        Raises:
            InputError: some were damaged on disk, told after the others were given; they are no longer done, so that
                the next run makes them anew. Or the disk cannot be read.
            ValueError: a row that is not done.
        """
        rows = np.flatnonzero(self.done).tolist() if rows is None else list(rows)
        if missing := [row for row in rows if self.counts[row] < 0]:
            raise ValueError(f"{self.folder}: row {missing[0]} is not done")
        damaged: dict[int, str] = {}
        requests = ((row, self._request(row)) for row in rows)
        waiting = deque(itertools.islice(requests, READ_AHEAD))
        while waiting:
            row, futures = waiting.popleft()
            waiting.extend(itertools.islice(requests, 1))
            with told(self.folder, self.kind.content):
                try:
                    parts = {name: future.result() for name, future in futures.items()}
                except ValueError as error:
                    if not is_damage(error):
                        raise
                    damaged[row] = reason(error)
                    continue
            yield row, parts
        if damaged:
            self._report(damaged)

    def _open(self, columns: Mapping[str, Column]) -> None:
        self._arrays.update(open_arrays(self.folder, len(self.counts), columns, self._context))
        self.columns.update(columns)

    def _write_part(self, row: int, name: str, part: np.ndarray) -> ts.WriteFutures:
        """Whole chunks: nothing is read before, so whatever an interrupted run left does not matter."""
        array, chunk = self._arrays[name], self.columns[name].chunk
        if chunk is None:
            return array[row].write(part)
        length = -(-len(part) // chunk) * chunk
        padded = np.full((length, *part.shape[1:]), np.nan, array.dtype.numpy_dtype)
        padded[: len(part)] = part
        return array[row, :length].write(padded)

    def _request(self, row: int) -> dict[str, ts.Future]:
        count = int(self.counts[row])
        return {
            name: (self._arrays[name][row, :count] if column.chunk else self._arrays[name][row]).read()
            for name, column in self.columns.items()
        }

    def _report(self, damaged: Mapping[int, str]) -> NoReturn:
        with told(self.folder, self.kind.content):
            commit([self._arrays["count"][row].write(-1) for row in damaged])
        self.counts[list(damaged)] = -1
        row, what = next(iter(damaged.items()))
        raise InputError(
            f"{self.folder}: {self.kind.content} of {len(damaged)} {self.kind.rows} are damaged on disk, the first in "
            f"row {row} ({what}); run again, which {self.kind.remake} them anew"
        )


@contextmanager
def open_rows(
    folder: Path,
    kind: Kind,
    recipe: Mapping[str, Any],
    sizes: Mapping[str, int],
    waiting: Callable[[str], None] | None = None,
) -> Iterator[RowStore]:
    """The store in `folder`, made if it is not there; no other process can open it meanwhile. No row is done yet.

    Args:
        folder: see `store_manifest.store_path`.
        kind: what it holds.
        recipe: what the rows are made from (JSON values only). Kept in plain text.
        sizes: lengths of axes by name, first that of the rows.
        waiting: is told, in one line, which process this waits for; None = refuse a store that is in use.

    Raises:
        InputError: made from something else, in use, no store at all, or the folder cannot be written.
    """
    folder = folder.absolute()  # the working directory may change
    with told(folder, kind.content):
        str(folder).encode()  # tensorstore takes no path that is not Unicode
        check_owned(folder, kind)
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, kind.content, waiting):
        with told(folder, kind.content):
            settle_manifest(folder, kind, recipe, sizes)
        counts = np.full(next(iter(sizes.values())), -1, np.int32)
        yield RowStore(folder, kind, counts, ts.Context({"file_io_sync": True}))  # one for all arrays


def forecast_bytes(columns: Mapping[str, Column], num_rows: int, entries_per_row: float) -> int:
    """Bytes on disk that rows with so many entries take at most."""

    def of(column: Column) -> float:
        values = math.prod(column.shape) * (entries_per_row if column.chunk else 1)
        return np.dtype(column.dtype).itemsize * values

    return num_rows * sum(int(-(-of(column) // BLOCK)) * BLOCK for column in (*columns.values(), Column("int32")))


def require_space(folder: Path, num_bytes: int) -> None:
    """Refuse to start what will not fit.

    Raises:
        InputError: less than `num_bytes` are free where `folder` is, or will be.
    """
    free = free_bytes(folder)
    if free < num_bytes:
        raise InputError(too_full(folder, num_bytes, free))
