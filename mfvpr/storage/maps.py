"""A map on disk: one SQLite file with a write-ahead log, which many processes read while one writes.

A row is in the file whole or not at all, also after a kill or on a full disk, and rows keep their order. Everything
has a checksum: the settings and other parts, features, and name, place and global descriptor together.
"""

import json
import os
import sqlite3
import time
import weakref
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mfvpr.core.types import Features
from mfvpr.storage.cache_files import disk_errors_as_input_errors, full_disk_error
from mfvpr.storage.packing import pack_arrays, pack_features, unpack_arrays, unpack_features
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, lock_folder

FILE = "map.sqlite"  # in the folder of the map
_FORMAT = 3
_WAIT = 60  # seconds for another process that writes
_SCHEMA = (
    "CREATE TABLE parts (name TEXT PRIMARY KEY, value BLOB NOT NULL, checksum INTEGER NOT NULL)",
    "CREATE TABLE entries (row INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, place TEXT NOT NULL, time REAL NOT NULL,"
    " vector BLOB NOT NULL, checksum INTEGER NOT NULL)",
    "CREATE TABLE features (row INTEGER PRIMARY KEY, count INTEGER NOT NULL, content BLOB NOT NULL)",
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
        self._stamp: tuple[int, int] | None = None  # of the file that is open
        with disk_errors_as_input_errors(self.folder):
            names = {path.name for path in folder.iterdir() if path.name[0] != "."} if folder.exists() else set()
        if names and FILE not in names:
            raise InputError(f"{folder}: expected a new or empty folder, or a map; name another")

    def part(self, name: str) -> bytes | None:
        """A part that was written: settings, vocabulary or confidence; None if it was not. InputError if damaged."""
        query = "SELECT value, checksum FROM parts WHERE name = ?"
        with self._open() as database:
            row: tuple[bytes, int] | None = database and database.execute(query, [name]).fetchone()
        if row is None:
            return None
        content, checksum = row
        if zlib.crc32(content) != checksum:
            raise self._damage(f"the {name}")
        return content

    def entries(self, start: int) -> Iterator[tuple[int, Entry]]:
        """(row, entry) of all rows from `start` on, in their order; an InputError if one is damaged or missing."""
        query = "SELECT row, name, place, vector, checksum FROM entries WHERE row >= ? ORDER BY row"
        with self._open() as database:
            for row, name, place, vector, checksum in database.execute(query, [start]) if database else ():
                if row != start or _checksum(name, place, vector) != checksum:
                    raise self._damage(f"row {start}")
                start += 1
                yield row, Entry(json.loads(name), json.loads(place), np.frombuffer(vector, np.float32))

    def counts(self) -> np.ndarray:
        """`[M]` numbers of keypoints of all rows."""
        with self._open() as database:
            rows = database.execute("SELECT count FROM features ORDER BY row").fetchall() if database else []
        return np.array(rows, int).reshape(-1)

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
        packed = list[tuple[Mapping[str, np.ndarray], Entry]]()
        for features, entry in images:
            try:
                packed.append((pack_features(features), entry))
            except ValueError as error:
                raise InputError(f"{entry.name}: {error}") from None
        with self._open(create=True) as database:
            assert database is not None
            database.execute("BEGIN IMMEDIATE")
            try:
                if database.execute("PRAGMA user_version").fetchone()[0] == 0:
                    for statement in _SCHEMA:
                        database.execute(statement)
                    database.execute(f"PRAGMA user_version = {_FORMAT}")
                of_parts = [(name, content, zlib.crc32(content)) for name, content in parts.items()]
                database.executemany("INSERT OR REPLACE INTO parts VALUES (?, ?, ?)", of_parts)
                [first] = database.execute("SELECT coalesce(max(row) + 1, 0) FROM entries").fetchone()
                for row, (arrays, entry) in enumerate(packed, first):
                    name, place = (json.dumps(value, allow_nan=False) for value in entry[:2])  # names may be no UTF-8
                    vector = np.asarray(entry.vector, np.float32).tobytes()
                    values = row, name, place, time.time(), vector, _checksum(name, place, vector)
                    database.execute("INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?)", values)
                    values = row, len(arrays["scores"]), pack_arrays(arrays)
                    database.execute("INSERT INTO features VALUES (?, ?, ?)", values)
                database.execute("COMMIT")
            except BaseException:
                if database.in_transaction:  # SQLite may have ended it
                    database.execute("ROLLBACK")
                raise

    @contextmanager
    def _open(self, *, create: bool = False) -> Iterator[sqlite3.Connection | None]:
        """The database, which stays open; None if there is no map yet. Errors are an InputError of one line."""
        try:
            with disk_errors_as_input_errors(self.folder):
                status = self._path.stat() if self._path.exists() else None
                if self._stamp is not None and (status is None or self._stamp != (status.st_dev, status.st_ino)):
                    got = "another one that replaced it, or none. Open the map again"
                    raise InputError(f"{self.folder}: expected the map that was opened, got {got}.")
                if status is None and not create:
                    yield None
                    return
                database = self._connect(create)
                version = database.execute("PRAGMA user_version").fetchone()[0]
                if version not in (0, _FORMAT):
                    raise InputError(f"{self._path}: expected format {_FORMAT}, got {version}. Build the map again.")
                yield database if version or create else None
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0)
            if code & 0xFF == sqlite3.SQLITE_FULL or code == sqlite3.SQLITE_IOERR_SHMSIZE:
                raise full_disk_error(self.folder) from None
            if code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                raise self._damage(f"the file ({error})") from None
            reason = f"cannot be used ({error}). Check the path, its permissions and its disk"
            raise InputError(f"{self._path}: {reason}.") from None

    def _connect(self, create: bool) -> sqlite3.Connection:
        """The connection; without write access a new one, which sees what was added since."""
        is_readonly = not create and not os.access(self.folder, os.W_OK)
        if self._database is None or is_readonly:
            how = "rwc" if create else "rw"
            if is_readonly:  # `immutable` needs no files of a log beside it, but would not see the rows in one
                how = "ro" if self._path.with_name(f"{FILE}-wal").exists() else "ro&immutable=1"
            self.folder.mkdir(parents=True, exist_ok=True)
            url, options = f"{self._path.as_uri()}?mode={how}", {"isolation_level": None, "check_same_thread": False}
            self._database = sqlite3.connect(url, uri=True, timeout=_WAIT, **options)
            weakref.finalize(self, self._database.close)
            status = self._path.stat()
            self._stamp = status.st_dev, status.st_ino
        if create:
            self._database.execute("PRAGMA journal_mode = WAL")
        return self._database

    def _damage(self, what: str) -> InputError:
        return InputError(f"{self._path}: {what} is damaged. Put back a copy, or build the map again.")


def _checksum(name: str, place: str, vector: bytes) -> int:
    return zlib.crc32(vector, zlib.crc32(f"{name} {place}".encode()))


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
