"""Read the matches of COLMAP's databases, SQLite files, without a change to them."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Num

from mfvpr.io.containers import reading, shorten
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader, Size
from mfvpr.utils.errors import InputError

_MOST_IMAGES = 2**31 - 1  # of COLMAP; the number of a pair is this times the number of the first image plus the other
_CENTER = 0.5  # the center of COLMAP's first pixel, px


class ColmapPairs(PairReader):
    """Reader of the table `matches`, or of `two_view_geometries` if `verified`."""

    by_number = True

    def __init__(self, path: Path, verified: bool = False) -> None:
        self.path = path
        self._table = "two_view_geometries" if verified else "matches"
        with self._open() as database:
            images = "SELECT name, image_id, width, height FROM images JOIN cameras USING (camera_id)"
            rows = database.execute(images).fetchall()
            self._pairs = {row[0] for row in database.execute(f"SELECT pair_id FROM {self._table}")}
        self._numbers = {name: number for name, number, *_ in rows}
        self._sizes: dict[str, Size] = {name: (width, height) for name, _, width, height in rows}
        self.images = tuple(self._numbers)

    def __contains__(self, pair: Pair) -> bool:
        return self._pair_id(pair) in self._pairs

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        with self._open() as database:
            for pair in pairs:
                where = f"{self.path}: {self._table} of {' and '.join(map(shorten, pair))}"
                query = f"SELECT rows, cols, data FROM {self._table} WHERE pair_id = ?"
                row = database.execute(query, (self._pair_id(pair),)).fetchone()
                numbers = _matrix(where, row, "<u4").astype(np.int64)
                yield FileMatches(numbers[:, 0], numbers[:, 1])

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"]:
        query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        with self._open() as database:
            row = database.execute(query, (self._numbers[image],)).fetchone()
        return _matrix(f"{self.path}: keypoints of {shorten(image)}", row, "<f4")[:, :2] - np.float32(_CENTER)

    def image_size(self, image: str) -> Size:
        return self._sizes[image]

    def _pair_id(self, pair: Pair) -> int:
        first, second = (self._numbers[name] for name in pair)
        return _MOST_IMAGES * first + second

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """The database, opened read-only; an InputError for changes beside it, and for SQLite's errors."""
        target = self.path.resolve()  # beside which SQLite writes its journals
        for journal in (Path(f"{target}-wal"), Path(f"{target}-journal")):
            if journal.is_file() and journal.stat().st_size:
                raise InputError(f"{self.path}: expected a closed database, got changes in {journal}; close COLMAP")
        address = f"file:{quote(str(target))}?mode=ro&immutable=1"  # writes no file beside it either
        with (
            reading(self.path, "a COLMAP database", "is it whole, and COLMAP's?"),
            closing(sqlite3.connect(address, uri=True)) as database,
        ):
            database.execute("PRAGMA trusted_schema = OFF")
            yield database


def _matrix(where: str, row: tuple[Any, Any, Any] | None, dtype: str) -> Num[np.ndarray, "rows columns"]:
    """The matrix of a row `(rows, cols, data)` of a table, of 2 or more columns."""
    rows, columns, content = row or (1, 0, None)
    columns, content = columns if rows else 2, content or b""
    size = len(content) if isinstance(content, bytes) else -1
    if columns < 2 or size != rows * columns * np.dtype(dtype).itemsize:
        raise InputError(f"{where}: expected rows of 2 or more {dtype}, got {rows} of {columns} in {size} bytes")
    return np.frombuffer(content, dtype).reshape(rows, columns)
