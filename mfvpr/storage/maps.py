"""The rows of a map on disk: for every image its features, its global descriptor, its name and its place.

    rows = MapRows(folder, recipe)
    with lock_map(folder):
        write_settings(folder, settings)
        with rows.adding() as add:
            add([(features, Entry(name, place, vector)), ...])
    for row, entry in rows.new():  # since the last time, whoever added them
        ...

One process adds at a time, any number read. Rows lie in segments of `SEGMENT`, so that no folder holds too many files.
A segment has two row stores (`mfvpr.storage.rows`) and a file of tokens: a random number of each row, which the files
of both stores know as well. So features and entries that were not written together are noticed. A row exists when its
token does, which is written last: no process sees half a row, and the next reader notices if a file is removed
later. A process that is killed leaves out row numbers.

The file of tokens grows before the files of a row are written: a row beyond its end shows that the file was cut. Until
the tokens are written it lacks one byte: its size changes with every new row, even where the clock stands still.

A map of format 1 has no tokens, and no manifest beside its segments. It can be read, but not added to.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from mfvpr.core.types import Features
from mfvpr.storage.disk import disk_errors_as_input_errors, lock_store
from mfvpr.storage.features import FeatureStore, open_store
from mfvpr.storage.manifest import (
    FEATURES,
    MANIFEST,
    Kind,
    has_manifest,
    manifest_of,
    remove_store_leftovers,
    write_manifest,
)
from mfvpr.storage.map_entries import Entry, EntryStore, open_entry_store
from mfvpr.utils.errors import InputError

SEGMENT = 4096  # rows
MAP = Kind("map", 2, "places", "images", None, compress=False)
_MAP_1, _FEATURES = replace(MAP, version=1), replace(FEATURES, remake=None)
_TOKENS, _TOKEN = "tokens", np.dtype("<u8")

MapImage = tuple[Features, Entry]


@contextmanager
def lock_map(folder: Path) -> Iterator[None]:
    """Lock a map, which may be missing: no other process learns its vocabulary or adds images."""
    with disk_errors_as_input_errors(folder, MAP.content):
        folder.mkdir(parents=True, exist_ok=True)
    with lock_store(folder, MAP.content):
        yield


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of a map within `lock_map`; an InputError if it has other settings, or format 1."""
    if _is_old(folder):
        raise InputError(f"{folder}: expected {MAP.format!r}, got {_MAP_1.format!r}, which can only be read. Build the "
                         "map anew in another folder.")  # fmt: skip
    with disk_errors_as_input_errors(folder, MAP.content):
        remove_store_leftovers(folder)
        write_manifest(folder, MAP, manifest_of(MAP, settings, {}))


def has_settings(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Whether the settings of a map are written; raises `InputError` if the map has other settings."""
    with disk_errors_as_input_errors(folder, MAP.content):
        return has_manifest(folder, MAP, manifest_of(MAP, settings, {}))


def has_rows(folder: Path) -> bool:
    """Whether rows were ever added to a map."""
    return _segment_folder(folder, 0).is_dir()


def _is_old(folder: Path) -> bool:
    """Whether a map is of format 1."""
    return has_rows(folder) and not ((folder / MANIFEST).exists() or (_segment_folder(folder, 0) / _TOKENS).exists())


def _segment_folder(folder: Path, number: int) -> Path:
    return folder / f"{number:04d}"


@dataclass
class _Segment:
    """Both stores of a segment, and its tokens, when they were opened."""

    features: FeatureStore
    entries: EntryStore
    tokens: np.ndarray  # [SEGMENT] of the rows that exist; 0 = no row
    stamp: tuple[int, ...] | None  # of the file of tokens
    known: np.ndarray  # [SEGMENT] bool, rows that `MapRows.new` gave

    @property
    def folder(self) -> Path:
        return self.entries.folder.parent

    @property
    def done(self) -> np.ndarray:
        """`[SEGMENT]` bool, rows that exist."""
        return (self.tokens > 0) & self.entries.done

    @property
    def taken(self) -> np.ndarray:
        """`[SEGMENT]` bool, rows that exist, or were begun, or are gone."""
        return (self.tokens > 0) | self.features.done | self.entries.done

    @property
    def is_current(self) -> bool:
        """Whether nothing was added or replaced since: that changes the file of tokens."""
        return self.entries.is_writable or self.stamp == file_stamp(self.folder / _TOKENS)

    @property
    def first_free(self) -> int:
        """The row behind those that are taken."""
        return int(np.max(np.flatnonzero(self.taken), initial=-1)) + 1

    def add(self, images: Sequence[MapImage]) -> None:
        """Write images to disk, behind the rows that are taken."""
        first = self.first_free
        rows = range(first, first + len(images))
        new = np.random.default_rng().integers(1, 2**64 - 1, len(images), np.uint64)
        self.tokens[first : rows.stop] = new
        try:
            features = self.features.pack({row: features for row, (features, _) in zip(rows, images, strict=True)})
            entries = self.entries.pack({row: entry for row, (_, entry) in zip(rows, images, strict=True)})
            with disk_errors_as_input_errors(self.folder, MAP.content), (self.folder / _TOKENS).open("r+b") as file:
                file.truncate(rows.stop * _TOKEN.itemsize - 1)
                os.fsync(file.fileno())  # a row must not be on disk before
                self.features.write_parts(features)
                self.entries.write_parts(entries)
                file.seek(first * _TOKEN.itemsize)
                file.write(new.astype(_TOKEN).tobytes())
                file.flush()
                os.fsync(file.fileno())
        except BaseException:  # also Ctrl-C: the rows are not there
            self.tokens[first : rows.stop] = 0
            raise
        self.stamp = file_stamp(self.folder / _TOKENS)

    def check(self) -> None:
        """Raise `InputError` if one of the two files of a row is gone, or the file of tokens is gone or was cut."""
        path = self.folder / _TOKENS
        stamp = file_stamp(path)  # the rows were listed earlier, and an add grows this file before it writes rows
        if self.entries.done.any() and stamp is None:
            raise InputError(f"{path}: expected a file, got none. Put it back.")
        rows = np.flatnonzero(self.features.done & self.entries.done)
        if stamp and len(lost := rows[(rows + 1) * _TOKEN.itemsize - 1 > stamp[0]]):
            raise InputError(f"{path}: expected tokens of rows up to {lost[-1]}, got a file that was cut to {stamp[0]} "
                             f"bytes. Put it back, or delete the files of {len(lost)} rows from {lost[0]} on in "
                             f"{self.features.folder} and {self.entries.folder}, which leaves them out.")  # fmt: skip
        halves = np.flatnonzero((self.tokens > 0) & (self.features.done != self.entries.done))
        if len(halves):
            row = halves[0]
            stores = self.features, self.entries
            missing, other = stores if self.entries.done[row] else stores[::-1]
            raise InputError(f"{missing.folder}: expected a file of row {row}, got none ({len(halves)} rows lack one). "
                             f"Put it back, or delete {other.folder}/{row}-{other.counts[row]}.npz as well, which "
                             "leaves the row out.")  # fmt: skip


@dataclass(eq=False)
class MapRows:
    """The rows of the map in a folder, which may be missing until the first is added, within `lock_map`."""

    folder: Path  # absolute
    recipe: Mapping[str, Any]  # of the rows (JSON values): a map with another recipe is refused
    _segments: list[_Segment] = field(default_factory=list, repr=False)

    def new(self) -> Iterator[tuple[int, Entry]]:
        """(row, entry) of new rows in their order; an InputError for a map of another recipe, damaged or replaced."""
        if self._segments:
            self._open(0)  # all maps have this segment: it shows whether the map was replaced
        growing = (number for number, segment in enumerate(self._segments) if not segment.known.all())
        number = next(growing, len(self._segments))
        while self._open(number):
            segment = self._segments[number]
            for row, entry in segment.entries.read(np.flatnonzero(segment.done & ~segment.known).tolist()):
                segment.known[row] = True
                yield number * SEGMENT + row, entry
            if not segment.taken[-1]:
                break
            number += 1

    def counts(self, rows: Iterable[int]) -> Int[np.ndarray, " rows"]:
        """Numbers of keypoints of rows, -1 = no such row."""
        row_numbers = np.fromiter(rows, int)
        counts = np.full(len(row_numbers), -1)
        for number in np.unique(row_numbers // SEGMENT):
            segment, is_here = self._segments[number], row_numbers // SEGMENT == number
            counts[is_here] = np.where(segment.done, segment.features.counts, -1)[row_numbers[is_here] % SEGMENT]
        return counts

    def features(self, rows: Sequence[int]) -> Iterator[tuple[int, Features]]:
        """(row, features) of existing rows, in no order; raises `InputError` if rows are damaged or were removed."""
        segments: dict[int, list[int]] = {}
        for row in rows:
            segments.setdefault(row // SEGMENT, []).append(row % SEGMENT)
        for number, segment_rows in segments.items():
            segment = self._segments[number]
            if gone := [row for row in segment_rows if not (segment.done & segment.features.done)[row]]:
                raise InputError(f"{self.folder}: expected features of row {number * SEGMENT + gone[0]}, got none. "
                                 "Open the map again, without rows that were deleted.")  # fmt: skip
            for row, features in segment.features.read(segment_rows):
                yield number * SEGMENT + row, features

    @contextmanager
    def adding(self) -> Iterator[Callable[[Sequence[MapImage]], None]]:
        """Lock the rows; yields a function that writes images to disk, behind all other rows, which stay."""
        with ExitStack() as stack:
            self._lock_last(stack)
            yield partial(self._add, stack)

    def _add(self, stack: ExitStack, images: Sequence[MapImage]) -> None:
        while images:
            segment = self._lock_last(stack)
            number = SEGMENT - segment.first_free
            segment.add(images[:number])
            images = images[number:]

    def _lock_last(self, stack: ExitStack) -> _Segment:
        """Lock the last segment, or a new one if it is full."""
        number = max(0, len(self._segments) - 1)
        while (segment := self._reopen(number)).taken[-1]:
            number += 1
        if not segment.entries.is_writable:
            for store in (segment.features, segment.entries):
                stack.enter_context(store)
            with disk_errors_as_input_errors(segment.folder, MAP.content):
                (segment.folder / _TOKENS).touch()
        return segment

    def _open(self, number: int) -> bool:
        """Open a segment, unless it is current; False if there never was one."""
        is_open = number < len(self._segments)
        if is_open and self._segments[number].is_current:
            return True
        if exists := is_open or _segment_folder(self.folder, number).is_dir():
            self._reopen(number)
        return exists

    def _reopen(self, number: int) -> _Segment:
        """Read the state of a segment on disk."""
        before = self._segments[number] if number < len(self._segments) else None
        if before is not None and before.entries.is_writable:
            return before
        folder, is_old = _segment_folder(self.folder, number), _is_old(self.folder)
        tokens, stamp = _read_tokens(folder / _TOKENS)  # before the names of files, which come first on disk
        options: dict[str, Any] = {"tokens": None if is_old else tokens}
        kind = _MAP_1 if is_old else MAP
        entries = open_entry_store(folder / "entries", self.recipe, num_images=SEGMENT, kind=kind, **options)
        features = open_store(folder / "features", self.recipe, num_images=SEGMENT, kind=_FEATURES, **options)
        known = np.zeros(SEGMENT, bool) if before is None else before.known
        segment = _Segment(features, entries, tokens, stamp, known)
        if is_old:
            tokens[entries.done] = 1
        else:
            segment.check()
        if before is not None and (before.tokens != tokens)[known].any():
            raise InputError(f"{self.folder}: expected the map that was opened, got another one that replaced it, or "
                             "none. Open the map again.")  # fmt: skip
        self._segments[number : number + 1] = [segment]
        return segment


def file_stamp(path: Path) -> tuple[int, ...] | None:
    """Size in bytes, inode and time of a file, which change when the file is replaced; None = no file."""
    with disk_errors_as_input_errors(path.parent, MAP.content):
        try:
            status = path.stat()
        except FileNotFoundError:
            return None
    return status.st_size, status.st_ino, status.st_mtime_ns


def _read_tokens(path: Path) -> tuple[np.ndarray, tuple[int, ...] | None]:
    """`[SEGMENT]` tokens, 0 beyond the end of the file, and the `file_stamp` of the file."""
    tokens, stamp = np.zeros(SEGMENT, _TOKEN), file_stamp(path)  # the stamp first: later changes are noticed
    with disk_errors_as_input_errors(path.parent, MAP.content):
        content = path.read_bytes() if stamp else b""
    stored = np.frombuffer(content, _TOKEN, len(content) // _TOKEN.itemsize)
    tokens[: len(stored)] = stored
    return tokens, stamp
