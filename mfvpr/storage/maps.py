"""A map on disk: one SQLite file, which many processes read while one writes.

A row is in the file whole or not at all, also after a kill or on a full disk, and rows keep their order. Everything
has a checksum: the settings and other parts, features, and the other values of a row together.
"""

import json
import sqlite3
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Features
from mfvpr.features.feature_set import strength
from mfvpr.storage.cache_files import (
    disk_errors_as_input_errors,
    pack_arrays,
    pack_features,
    unpack_arrays,
    unpack_features,
)
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, lock_folder

FILE = "map.sqlite"  # in the folder of the map
_FORMAT = 4
_WAIT = 60  # seconds for another process that writes
_SCHEMA = (
    "CREATE TABLE parts (name TEXT PRIMARY KEY, value BLOB NOT NULL, checksum INTEGER NOT NULL)",
    "CREATE TABLE entries (row INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, place TEXT NOT NULL,"
    " keypoints INTEGER NOT NULL, strength REAL NOT NULL, vector BLOB NOT NULL, checksum INTEGER NOT NULL)",
    "CREATE TABLE features (row INTEGER PRIMARY KEY, content BLOB NOT NULL)",
)


class Entry(NamedTuple):
    """The data of an image in a map, without its features; the place is any JSON value."""

    name: str
    place: Any
    vector: Float[np.ndarray, " dimensions"]


class MapFile:
    """The file of the map in a folder, which may be missing until something is written.

    Used by one thread at a time. `lock` keeps others from building and adding meanwhile.
    """

    def __init__(self, folder: Path) -> None:
        """Open nothing yet; an InputError for a folder of something else."""
        self.folder, self._path = folder.absolute(), folder.absolute() / FILE
        self._database: sqlite3.Connection | None = None
        with disk_errors_as_input_errors(self.folder):
            names = {path.name for path in folder.iterdir() if path.name[0] != "."} if folder.exists() else set()
        if names and FILE not in names:
            raise InputError(f"{folder}: expected a new or empty folder, or a map; name another")

    def part(self, name: str) -> bytes | None:
        """A part that was written, such as settings or vocabulary; None if it was not. InputError if damaged."""
        query = "SELECT value, checksum FROM parts WHERE name = ?"
        with self._open() as database:
            row: tuple[bytes, int] | None = database and database.execute(query, [name]).fetchone()
        if row is not None and zlib.crc32(row[0]) != row[1]:
            raise self._damage(f"the {name}")
        return None if row is None else row[0]

    def entries(self, start: int) -> Iterator[tuple[Entry, int, float]]:
        """Entries of rows from `start` on, with number and strength of keypoints; an InputError if one is damaged."""
        query = "SELECT * FROM entries WHERE row >= ? ORDER BY row"
        with self._open() as database:
            rows: Iterable[Any] = database.execute(query, [start]) if database else ()
            for number, (row, *values, checksum) in enumerate(rows, start):
                if row != number or _checksum(values) != checksum:
                    raise self._damage(f"row {number}")
                name, place, keypoints, sum_of_scores, vector = values
                entry = Entry(json.loads(name), json.loads(place), np.frombuffer(vector, np.float32))
                yield entry, keypoints, sum_of_scores

    def features(self, rows: Sequence[int]) -> Iterator[tuple[int, Features]]:
        """(row, features) of existing rows, in their order; an InputError if one is damaged."""
        query = "SELECT content FROM features WHERE row = ?"
        with self._open() as database:
            for row in rows:
                content: tuple[bytes] | None = database and database.execute(query, [row]).fetchone()
                try:
                    features = unpack_features(unpack_arrays(content[0] if content else b""))
                except InputError:
                    raise self._damage(f"row {row}") from None
                yield row, features

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the map for a process that learns, builds or adds; an InputError if another one does."""
        with disk_errors_as_input_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        busy = InputError(f"{self.folder}: another process adds images; wait until it ends, or stop it")
        with lock_folder(self.folder, busy):
            yield

    def write(self, parts: Mapping[str, bytes], images: Sequence[tuple[Features, Entry]] = ()) -> None:
        """Write parts, which replace earlier ones, and images behind all rows: all of it, or nothing.

        When this returns it is on disk. An InputError if the disk is full or cannot be written.
        """
        rows = list[tuple[tuple[Any, ...], bytes]]()
        for features, entry in images:
            try:
                arrays = pack_features(features)
            except ValueError as error:
                raise InputError(f"{entry.name}: {error}") from None
            name, place = (json.dumps(value, allow_nan=False) for value in entry[:2])  # names may be no UTF-8
            vector = np.asarray(entry.vector, np.float32).tobytes()
            values = name, place, len(arrays["scores"]), strength(features), vector
            rows.append((values, pack_arrays(arrays)))
        with self._open(create=True) as database, database:  # which commits, or rolls back
            database.execute("BEGIN IMMEDIATE")
            if database.execute("PRAGMA user_version").fetchone()[0] == 0:
                for statement in (*_SCHEMA, f"PRAGMA user_version = {_FORMAT}"):
                    database.execute(statement)
            of_parts = [(name, content, zlib.crc32(content)) for name, content in parts.items()]
            database.executemany("INSERT OR REPLACE INTO parts VALUES (?, ?, ?)", of_parts)
            [first] = database.execute("SELECT coalesce(max(row) + 1, 0) FROM entries").fetchone()
            for row, (values, content) in enumerate(rows, first):
                database.execute("INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?, ?)", (row, *values, _checksum(values)))
                database.execute("INSERT INTO features VALUES (?, ?)", (row, content))

    @contextmanager
    def _open(self, *, create: bool = False) -> Iterator[Any]:
        """The `sqlite3.Connection`, which stays open; None if there is no map yet. Errors are an InputError."""
        with disk_errors_as_input_errors(self._path):
            if self._database is None and (create or self._path.exists()):
                self.folder.mkdir(parents=True, exist_ok=True)
                url, options = f"{self._path.as_uri()}?mode=rw{'c' * create}", {"isolation_level": None, "uri": True}
                self._database = sqlite3.connect(url, timeout=_WAIT, check_same_thread=False, **options)
                weakref.finalize(self, self._database.close)
            version = self._database.execute("PRAGMA user_version").fetchone()[0] if self._database else 0
            if version not in (0, _FORMAT):
                raise InputError(f"{self._path}: expected format {_FORMAT}, got {version}. Build the map again.")
            yield self._database if version or create else None

    def _damage(self, what: str) -> InputError:
        return InputError(f"{self._path}: {what} is damaged. Put back a copy, or build the map again.")


def _checksum(values: Sequence[Any]) -> int:
    *numbers, vector = values
    return zlib.crc32(vector, zlib.crc32(repr(numbers).encode()))


def check_entry(name: Any, place: Any) -> None:
    """Refuse a name that is no text, and a place that is None or that JSON would change: a tuple becomes a list."""
    if not isinstance(name, str):
        raise InputError(f"name: expected text, got {clip_middle(repr(name), 80)}. Use `str(name)`.")
    try:
        text = json.dumps(place, allow_nan=False)
        if place is None or json.loads(text) != place:
            raise ValueError(f"{clip_middle(repr(place), 80)}, which JSON gives back as {clip_middle(text, 80)}")
    except (TypeError, ValueError, RecursionError) as error:
        fix = "use text, numbers, lists, and dictionaries by text"
        raise InputError(f"{name}: expected a place that JSON can say, and not null, got {error}; {fix}") from None
