"""Read the matches of COLMAP's databases, SQLite files, without a change to them."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Num

from mfvpr.io.containers import reading, shorten
from mfvpr.io.formats.pairs import FileMatches, Pair, PairReader, Size
from mfvpr.utils.errors import InputError

_MOST_IMAGES = 2**31 - 1  # of COLMAP; the number of a pair is this times the number of the first image plus the other
_CENTER = 0.5  # the center of COLMAP's first pixel, px
_JOURNALS = ("-wal", "-journal")  # files of changes that are not in the database yet


class ColmapPairs(PairReader):
    """Reader of the table `matches`, or of `two_view_geometries` if `verified`."""

    by_number, has_confidences = True, False

    def __init__(self, path: Path, verified: bool = False) -> None:
        self.path = path
        self._target = path.resolve()  # beside which SQLite writes its journals
        self._table = "two_view_geometries" if verified else "matches"
        with self._open() as database:
            rows = database.execute("SELECT image_id, name, camera_id FROM images").fetchall()
            cameras = {row[0]: row[1:] for row in database.execute("SELECT camera_id, width, height FROM cameras")}
            self._pairs = {row[0] for row in database.execute(f"SELECT pair_id FROM {self._table}")}
        if not all(
            type(number) is int and isinstance(name, str) and camera in cameras for number, name, camera in rows
        ):
            raise InputError(f"{path}: expected images with a name and a camera of the table cameras; make it again")
        self._numbers = {name: number for number, name, _ in rows}
        self._sizes: dict[str, Size] = {name: cameras[camera] for _, name, camera in rows}
        self.images = tuple(self._numbers)

    def __contains__(self, pair: Pair) -> bool:
        first, second = (self._numbers[name] for name in pair)
        return _MOST_IMAGES * first + second in self._pairs

    def read(self, pairs: Sequence[Pair]) -> Iterator[FileMatches]:
        with self._open() as database:
            for pair in pairs:
                first, second = (self._numbers[name] for name in pair)
                where = f"{self.path}: {self._table} of {' and '.join(map(shorten, pair))}"
                query = f"SELECT rows, cols, data FROM {self._table} WHERE pair_id = ?"
                row = database.execute(query, (_MOST_IMAGES * first + second,)).fetchone()
                numbers = _matrix(where, row, np.dtype("<u4"), 2).astype(np.int64)
                yield FileMatches(numbers[:, 0], numbers[:, 1])

    def keypoints(self, image: str) -> Float[np.ndarray, "keypoints 2"]:
        query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
        with self._open() as database:
            row = database.execute(query, (self._numbers[image],)).fetchone()
        where = f"{self.path}: keypoints of {shorten(image)}"
        if row is None:
            raise InputError(f"{where}: expected keypoints of every image with matches, got none; make it again")
        return _matrix(where, row, np.dtype("<f4"))[:, :2] - np.float32(_CENTER)

    def image_size(self, image: str) -> Size:
        return self._sizes[image]

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """The database, opened read-only; raise an InputError for changes beside it, and for SQLite's errors."""
        for journal in (Path(f"{self._target}{suffix}") for suffix in _JOURNALS):
            if journal.is_file() and journal.stat().st_size:
                raise InputError(
                    f"{self.path}: expected a closed database, got changes in {journal.name}; close COLMAP"
                )
        address = f"file:{quote(str(self._target))}?mode=ro&immutable=1"  # writes no file beside it either
        with (
            reading(self.path, "a COLMAP database", "is it whole, and COLMAP's?"),
            closing(sqlite3.connect(address, uri=True)) as database,
        ):
            database.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
            database.execute("PRAGMA trusted_schema = OFF")
            kinds = dict(database.execute("SELECT name, type FROM sqlite_master"))
            for table in ("images", "cameras", "keypoints", self._table):
                columns = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
                if kinds.get(table) != "table" or any(is_hidden for *_, is_hidden in columns):
                    raise InputError(f"expected COLMAP's table {table}, without generated columns, got none")
            yield database


def _matrix(
    where: str, row: tuple[object, object, object], dtype: np.dtype, columns: int | None = None
) -> Num[np.ndarray, "rows columns"]:
    """The matrix of a row `(rows, cols, data)` of a table."""
    rows, cols, data = row
    content = b"" if data is None else data
    if not (
        isinstance(rows, int) and isinstance(cols, int) and isinstance(content, bytes) and rows >= 0
        and (not rows or (cols == columns if columns else cols >= 2)) and len(content) == rows * cols * dtype.itemsize
    ):  # fmt: skip
        size = len(content) if isinstance(content, bytes) else type(data).__name__
        raise InputError(f"{where}: expected {columns or '2 or more'} columns of {dtype.name}, got {rows} rows of "
                         f"{cols} in {size} bytes; make it again")  # fmt: skip
    return np.frombuffer(content, dtype).reshape(rows, columns or max(cols, 2))
