"""A map on disk: one SQLite file with a write-ahead log, which many processes read while one writes.

A row is in the file whole or not at all, also after a kill or on a full disk, and rows keep their order. Everything
has a checksum: the settings and other parts, features, and name, place and global descriptor together.
"""

import json
import os
import sqlite3
import time
import uuid
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
from mfvpr.storage.packing import pack_features, unpack_features
from mfvpr.utils.arrays import pack_arrays, unpack_arrays
from mfvpr.utils.errors import InputError
from mfvpr.utils.files import clip_middle, lock_folder

FILE = "map.sqlite"  # in the folder of the map
_FORMAT = 3
_WAIT = 60  # seconds for another process that writes
_AT_ONCE = 500  # rows of a query, whose number of parameters is limited
_SCHEMA = """
CREATE TABLE parts (name TEXT PRIMARY KEY, value BLOB NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE entries (row INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, place TEXT NOT NULL, time REAL NOT NULL,
                      vector BLOB NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE features (row INTEGER PRIMARY KEY, count INTEGER NOT NULL, content BLOB NOT NULL);
"""


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
        """Open nothing yet; an InputError for a map of an earlier version, or a folder of something else."""
        self.folder, self._path = folder.absolute(), folder.absolute() / FILE
        self._database: sqlite3.Connection | None = None
        self._stamp: tuple[int, int] | None = None  # of the file that is open
        self._id: bytes | None = None  # of the map that is open: every map has another one
        with disk_errors_as_input_errors(self.folder):
            names = {path.name for path in folder.iterdir() if path.name[0] != "."} if folder.exists() else set()
        if FILE not in names and names & {"0000", "settings.json", "vocabulary.npz"}:
            raise InputError(f"{folder}: expected a map of this version, got one of an earlier version. Build it again "
                             "in another folder.")  # fmt: skip
        if names and FILE not in names:
            raise InputError(f"{folder}: expected a new or empty folder, or a map; name another")

    def part(self, name: str) -> bytes | None:
        """A part that was written: settings, vocabulary or confidence; None if it was not. InputError if damaged."""
        query = "SELECT value, checksum FROM parts WHERE name = ?"
        with self._reading() as database:
            row: tuple[bytes, int] | None = database and database.execute(query, [name]).fetchone()
        if row is None:
            return None
        content, checksum = row
        if zlib.crc32(content) != checksum:
            raise InputError(f"{self._path}: the {name} is damaged. Put back a copy, or build the map again.")
        return content

    def arrays(self, name: str) -> dict[str, np.ndarray] | None:
        """Arrays that were written as a part."""
        content = self.part(name)
        return None if content is None else unpack_arrays(content, name)

    def entries(self, start: int) -> Iterator[tuple[int, Entry]]:
        """(row, entry) of all rows from `start` on, in their order; an InputError if one is damaged or missing."""
        query = "SELECT row, name, place, vector, checksum FROM entries WHERE row >= ? ORDER BY row"
        with self._reading() as database:
            for row, name, place, vector, checksum in database.execute(query, [start]) if database else ():
                if row != start or _checksum(name, place, vector) != checksum:
                    raise self._damage(start)
                start += 1
                yield row, Entry(json.loads(name), json.loads(place), np.frombuffer(vector, np.float32))

    def counts(self) -> np.ndarray:
        """`[M]` numbers of keypoints of all rows."""
        with self._reading() as database:
            rows = database.execute("SELECT count FROM features ORDER BY row").fetchall() if database else []
        return np.array(rows, int).reshape(-1)

    def features(self, rows: Sequence[int]) -> Iterator[tuple[int, Features]]:
        """(row, features) of existing rows, in no order; an InputError if one is damaged."""
        for start in range(0, len(rows), _AT_ONCE):
            part = rows[start : start + _AT_ONCE]
            query = f"SELECT row, content FROM features WHERE row IN ({','.join('?' * len(part))})"
            with self._reading() as database:
                found: dict[int, bytes] = dict(database.execute(query, part)) if database else {}
            for row in part:
                try:
                    yield row, unpack_features(unpack_arrays(found.get(row, b""), str(row)))
                except InputError:
                    raise self._damage(row) from None

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
        with self._errors():
            self.folder.mkdir(parents=True, exist_ok=True)
            database = self._connect(create=True)
            database.execute("BEGIN IMMEDIATE")
            try:
                self._write(database, parts, packed)
                database.execute("COMMIT")
            except BaseException:
                if database.in_transaction:  # SQLite may have ended it
                    database.execute("ROLLBACK")
                raise

    def _write(
        self,
        database: sqlite3.Connection,
        parts: Mapping[str, bytes],
        images: Sequence[tuple[Mapping[str, np.ndarray], Entry]],
    ) -> None:
        if database.execute("PRAGMA user_version").fetchone()[0] == 0:
            for statement in filter(str.strip, _SCHEMA.split(";")):
                database.execute(statement)
            database.execute(f"PRAGMA user_version = {_FORMAT}")
            parts = {"id": uuid.uuid4().bytes, **parts}
        self._check_id(database)
        of_parts = [(name, content, zlib.crc32(content)) for name, content in parts.items()]
        database.executemany("INSERT OR REPLACE INTO parts VALUES (?, ?, ?)", of_parts)
        [first] = database.execute("SELECT coalesce(max(row) + 1, 0) FROM entries").fetchone()
        for row, (arrays, entry) in enumerate(images, first):
            name, place = (json.dumps(value, allow_nan=False) for value in entry[:2])  # ASCII: names may be no UTF-8
            vector = np.asarray(entry.vector, np.float32).tobytes()
            values = row, name, place, time.time(), vector, _checksum(name, place, vector)
            database.execute("INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?)", values)
            content = pack_arrays(arrays, str(row))
            database.execute("INSERT INTO features VALUES (?, ?, ?)", (row, len(arrays["scores"]), content))

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection | None]:
        """The database, None if there is no map yet."""
        with self._errors():
            if not self._path.exists():
                if self._id is not None:
                    raise self._replaced()
                yield None
                return
            database = self._connect(create=False)
            version = database.execute("PRAGMA user_version").fetchone()[0]
            if version not in (0, _FORMAT):
                raise InputError(f"{self._path}: expected a map of format {_FORMAT}, got {version}. Build it again.")
            if version:
                self._check_id(database)
            yield database if version else None

    def _check_id(self, database: sqlite3.Connection) -> None:
        found = database.execute("SELECT value FROM parts WHERE name = 'id'").fetchone()
        if self._id is not None and found != (self._id,):
            raise self._replaced()
        self._id = found and found[0]

    def _connect(self, *, create: bool) -> sqlite3.Connection:
        """The connection, a new one if the file was replaced."""
        status = self._path.stat() if self._path.exists() else None
        is_readonly = not create and not os.access(self.folder, os.W_OK)
        if is_readonly or self._database is None or status is None or (status.st_dev, status.st_ino) != self._stamp:
            how = "?mode=rwc" if create else "?mode=rw"
            if is_readonly:  # `immutable` needs no files of a log beside it, but would not see the rows in one
                how = "?mode=ro" if self._path.with_name(f"{FILE}-wal").exists() else "?mode=ro&immutable=1"
            self._database = sqlite3.connect(
                self._path.as_uri() + how, uri=True, timeout=_WAIT, isolation_level=None, check_same_thread=False
            )
            weakref.finalize(self, self._database.close)
            if create:
                self._database.execute("PRAGMA journal_mode = WAL")
            status = self._path.stat()
            self._stamp = status.st_dev, status.st_ino
        return self._database

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Raise errors of SQLite and of the file system as an InputError of one line."""
        try:
            with disk_errors_as_input_errors(self.folder):
                yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0)
            if code & 0xFF == sqlite3.SQLITE_FULL or code == sqlite3.SQLITE_IOERR_SHMSIZE:
                raise full_disk_error(self.folder) from None
            if code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                reason = f"is damaged ({error}). Put back a copy, or build the map again"
            else:
                reason = f"cannot be used ({error}). Check the path, its permissions and its disk"
            raise InputError(f"{self._path}: {reason}.") from None

    def _damage(self, row: int) -> InputError:
        return InputError(f"{self._path}: row {row} is damaged. Put back a copy, or build the map again.")

    def _replaced(self) -> InputError:
        return InputError(f"{self.folder}: expected the map that was opened, got another one that replaced it, or "
                          "none. Open the map again.")  # fmt: skip


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
        raise InputError(f"{name}: expected a place that JSON can say, and not null, got {error}; use text, numbers, "
                         "lists, and dictionaries by text") from None  # fmt: skip
