"""Where each query really is: by file order, an index file, or UTM coordinates in the file names.

Truth comes in two kinds, each with a threshold that decides what still counts: frames of the database sequence, or a
radius in meters.
"""

import csv
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from mfvpr.errors import InputError
from mfvpr.evaluation import frame_positives, radius_positives


@dataclass(frozen=True)
class FrameTruth:
    """The database rows that show each query's place; neighbors within a tolerance in frames count as well."""

    unit: ClassVar[str] = "frames"
    rows: tuple[tuple[int, ...], ...]  # per query; empty = unknown place, which counts as a failure
    num_database: int

    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool for a tolerance in frames, inclusive."""
        positives = np.zeros((len(self.rows), self.num_database), bool)
        for place in range(max(map(len, self.rows), default=0)):
            index = np.array([rows[place] if place < len(rows) else -1 for rows in self.rows])
            positives |= frame_positives(index, np.arange(self.num_database), tolerance=int(threshold))
        return positives

    def place(self, query: int) -> int | None:
        """The database row that shows the query's place best, None if there is none."""
        return self.rows[query][0] if self.rows[query] else None


@dataclass(frozen=True)
class RadiusTruth:
    """Positions in meters; database images within a radius of the query count."""

    unit: ClassVar[str] = "m"
    query_xy: np.ndarray  # [Q, 2]
    database_xy: np.ndarray  # [N, 2]

    def positives(self, threshold: float) -> np.ndarray:
        """`[Q, N]` bool for a radius in meters, inclusive."""
        return radius_positives(self.query_xy, self.database_xy, radius=threshold)

    def place(self, query: int) -> int | None:
        """The database row nearest to the query."""
        return int(np.argmin(np.linalg.norm(self.database_xy - self.query_xy[query], axis=1)))


Truth = FrameTruth | RadiusTruth


def truth_by_order(num_queries: int, num_database: int) -> FrameTruth:
    """Query i shows database image i, in file order."""
    if num_queries != num_database:
        raise InputError(
            f"ground truth by file order: expected as many queries as database images, got {num_queries} and "
            f"{num_database}; use dataset.ground_truth=index with dataset.index_file=FILE, utm, or none"
        )
    return FrameTruth(tuple((row,) for row in range(num_queries)), num_database)


def truth_from_names(query_names: Sequence[str], database_names: Sequence[str]) -> RadiusTruth:
    """UTM easting and northing from names `@easting@northing@...` (the convention of VPR-datasets-downloader)."""
    return RadiusTruth(
        np.array([_position(name) for name in query_names]), np.array([_position(name) for name in database_names])
    )


def truth_from_file(path: Path, query_names: Sequence[str], database_names: Sequence[str]) -> Truth:
    """Truth from an index file.

    * `.csv`: a header with the columns `query` and `database` (or SSM-VPR's `Live` and `Reference`), then one line per
      pair: file names, or numbers from 0 in file order. Several lines for one query are several true places; an empty
      database cell says that there is none.
    * `.npz`: arrays `query` and `database`, the same pairs; or Patch-NetVLAD's `utmQ` and `utmDb`.
    * `.json`: VPR-Bench's `[[query, [database, ...]], ...]`.
    """
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path}: expected an index file (.csv, .npz or .json), got {found}; set dataset.index_file")
    readers = {".csv": _csv_pairs, ".npz": _npz_pairs, ".json": _json_pairs}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected an index file named .csv, .npz or .json, got {path.suffix or 'no suffix'}")
    try:
        found = readers[path.suffix.lower()](path)
    except InputError:
        raise
    except Exception as error:  # a parser on a foreign file
        if "allow_pickle" in str(error):
            error = ValueError("it holds Python objects, which are never loaded")
        raise InputError(f"{path}: cannot be read as {path.suffix} ({error}); see README, Your own images") from None
    if isinstance(found, RadiusTruth):
        _same_count(path, "query positions (utmQ)", len(found.query_xy), len(query_names))
        _same_count(path, "database positions (utmDb)", len(found.database_xy), len(database_names))
        return found
    return _frame_truth(path, found, query_names, database_names)


def _frame_truth(
    path: Path, pairs: Iterable[tuple[Any, Any]], queries: Sequence[str], database: Sequence[str]
) -> Truth:
    query_rows, database_rows = _row_table(queries), _row_table(database)
    rows: dict[int, list[int]] = {}
    for line, (query, place) in enumerate(pairs, start=1):
        row = _row(path, line, "query", query, query_rows, len(queries))
        places = rows.setdefault(row, [])
        if str(place).strip():
            places.append(_row(path, line, "database", place, database_rows, len(database)))
    missing = [name for row, name in enumerate(queries) if row not in rows]
    if missing:
        raise InputError(
            f"{path}: expected ground truth for all {len(queries)} queries, got it for {len(rows)}; the first without "
            f"is {missing[0]} (a line with an empty database cell says that it has no place)"
        )
    return FrameTruth(tuple(tuple(rows[row]) for row in range(len(queries))), len(database))


def _csv_pairs(path: Path) -> list[tuple[str, str]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file)
        names = {name.strip().lower(): name for name in reader.fieldnames or []}
        for query, database in (("query", "database"), ("live", "reference")):
            if query in names and database in names:
                return [(line[names[query]] or "", line[names[database]] or "") for line in reader]
    raise InputError(f"{path}: expected a header with the columns query,database; got {','.join(names) or 'no header'}")


def _npz_pairs(path: Path) -> list[tuple[Any, Any]] | RadiusTruth:
    with np.load(path, allow_pickle=False) as arrays:
        if {"utmQ", "utmDb"} <= set(arrays):
            positions = [arrays[name].astype(np.float64) for name in ("utmQ", "utmDb")]
            for name, xy in zip(("utmQ", "utmDb"), positions, strict=True):
                if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
                    raise InputError(
                        f"{path}: {name}: expected finite positions [n, 2] in meters, got shape {xy.shape}"
                    )
            return RadiusTruth(*positions)
        if {"query", "database"} <= set(arrays):
            if arrays["query"].shape != arrays["database"].shape or arrays["query"].ndim != 1:
                raise InputError(f"{path}: expected query and database of one length, got "
                                 f"{arrays['query'].shape} and {arrays['database'].shape}")  # fmt: skip
            return list(zip(arrays["query"].tolist(), arrays["database"].tolist(), strict=True))
        raise InputError(f"{path}: expected arrays query and database, or utmQ and utmDb; got {', '.join(arrays)}")


def _json_pairs(path: Path) -> list[tuple[Any, Any]]:
    entries = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(entries, list) or not all(
        isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list) for entry in entries
    ):
        raise InputError(f"{path}: expected [[query, [database, ...]], ...] as in VPR-Bench")
    return [(query, place) for query, places in entries for place in (places or [""])]


def _row_table(names: Sequence[str]) -> dict[str, int]:
    """Rows by relative path, and by file name where that is unique."""
    table: dict[str, int] = {}
    ambiguous = set()
    for row, name in enumerate(names):
        base = PurePosixPath(name).name
        ambiguous |= {base} & table.keys()
        table[base] = row
    table = {base: row for base, row in table.items() if base not in ambiguous}
    return table | {name: row for row, name in enumerate(names)}


def _row(path: Path, line: int, side: str, value: Any, table: dict[str, int], count: int) -> int:
    text = str(value).strip()
    if text in table:
        return table[text]
    if text.isascii() and text.isdigit() and int(text) < count:
        return int(text)
    raise InputError(
        f"{path}: pair {line}: expected the name of a {side} image or a number from 0 to {count - 1}, got {text!r}"
    )


def _position(name: str) -> tuple[float, float]:
    """Easting, northing of one name; folders above the file may contain '@' as well."""
    fields = PurePosixPath(name).name.split("@")
    try:
        easting, northing = float(fields[1]), float(fields[2])
    except (IndexError, ValueError):
        raise InputError(f"{name}: expected a name like @easting@northing@...; use dataset.ground_truth=none") from None
    if not (math.isfinite(easting) and math.isfinite(northing)):
        raise InputError(f"{name}: expected finite easting and northing, got {easting} and {northing}")
    return easting, northing


def _same_count(path: Path, what: str, got: int, expected: int) -> None:
    if got != expected:
        raise InputError(f"{path}: expected {expected} {what}, one per image, got {got}")
