"""Ground truth: positives at a threshold; by file order, UTM coordinates in names, or from files as data.

There are three units. Frames of the database sequence and meters have a threshold, exact ground truth has none.
"""

import csv
import json
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float, Int, Num

from mfvpr.datasets.positives import Positives, positives_within, require_positions
from mfvpr.io.containers import parse_number, read_npz, reading, require_all, shorten
from mfvpr.utils.errors import InputError

Unit = Literal["frames", "m", "exact"]
TOLERANCES = (1, 2, 5)  # frames
RADIUS = 25.0  # meters
CHOICES = (
    "order (query i shows database image i); index (a file of pairs); utm (positions in the names, "
    "@easting@northing@...); label (two csv files of name,label: images with the same label (floor, room) are "
    "correct); none (rankings only)"
)
_LINES = "lines (with an empty cell if it has no place or label)"
_reading = partial(reading, kind="a ground truth file", mend="see mfvpr/datasets/README.md")


class Truth(ABC):
    """The correct database images of each query; a base class for ground truth of your own.

    Example:
        data.truth.positives(2).of(5)  # database rows within 2 frames of query 5
    """

    @property
    @abstractmethod
    def unit(self) -> Unit:
        """Unit of thresholds; "exact" = thresholds do not matter."""

    @abstractmethod
    def positives(self, threshold: float) -> Positives:
        """Correct database images at a threshold, inclusive."""

    def shows_place(self, threshold: float) -> Positives:
        """Database images of the query's place, including images that are excluded from its candidates."""
        return self.positives(threshold)

    @abstractmethod
    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        """Distance of each database image to the query's place, in the unit; infinite = never correct."""

    def place(self, query: int) -> int | None:
        """The database row nearest to the query's place; None if the place is unknown."""
        distance = self.distance(query)
        nearest = int(np.argmin(distance)) if distance.size else None
        return nearest if nearest is not None and np.isfinite(distance[nearest]) else None

    def thresholds(self, *, tolerances: Iterable[int] = TOLERANCES, radius: float = RADIUS) -> list[float]:
        """Thresholds in the unit, ascending: tolerances in frames, the radius in meters, or 0 if exact."""
        return {"frames": sorted(set(tolerances)), "m": [radius], "exact": [0]}[self.unit]


def middle(thresholds: Sequence[float]) -> float:
    """The main threshold, for predictions, failures, figures and confidence; at least one is required."""
    return thresholds[len(thresholds) // 2]


def threshold_words(unit: Unit, threshold: float) -> str:
    """Text of a threshold behind R@K in tables, for example " ±2"."""
    return {"frames": f" ±{threshold:g}", "m": f" {threshold:g} m", "exact": ""}[unit]


@dataclass(frozen=True)
class FrameTruth(Truth):
    """The database rows that show each query's place; neighbors within a tolerance in frames count as well.

        mfvpr.datasets.FrameTruth(((0,), (2, 3), ()), num_database=5).positives(1).of(0)  # [0, 1]

    Attributes:
        rows: per query; empty = unknown place, which counts as a failure.
        num_database: N.
        widened: False = neighbors do not count, at any tolerance, and the unit is "exact".
        starts: database rows at which a new drive begins, ascending; neighbors are of the same drive.
    """

    rows: tuple[tuple[int, ...], ...]
    num_database: int
    widened: bool = True
    starts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if (rows := {*chain(*self.rows)}) and not 0 <= min(rows) <= max(rows) < self.num_database:
            expected, got = f"rows of a database of {self.num_database} images", f"{min(rows)} to {max(rows)}"
            raise InputError(f"rows: expected {expected}, got {got}; an unknown place has no rows")

    @property
    def unit(self) -> Unit:
        return "frames" if self.widened else "exact"

    def positives(self, threshold: float) -> Positives:
        tolerance = int(min(threshold, self.num_database)) if self.widened else 0
        near = {}  # rows within the tolerance of a row, in its drive
        for row in {*chain(*self.rows)}:
            first, last = self._drive(row)
            near[row] = range(max(row - tolerance, first), min(row + tolerance + 1, last))
        return Positives.from_rows(([*chain(*(near[row] for row in rows))] for rows in self.rows), self.num_database)

    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        distance = np.full(self.num_database, np.inf)
        for row in self.rows[query]:
            drive = slice(*self._drive(row))
            distance[drive] = np.minimum(distance[drive], np.abs(np.arange(self.num_database) - row)[drive])
        return distance if self.widened else np.where(distance > 0, np.inf, 0.0)

    def _drive(self, row: int) -> tuple[int, int]:
        """First and last + 1 database row of a row's drive."""
        bounds = (0, *self.starts, self.num_database)
        number = bisect_right(bounds, row)
        return bounds[number - 1], bounds[number]


@dataclass(frozen=True)
class RadiusTruth(Truth):
    """Positions in meters, finite, up to 1e9; database images within a radius of the query are correct.

    Example:
        xy = np.stack([2.0 * np.arange(10), np.zeros(10)], axis=1)  # a position every 2 m
        mfvpr.datasets.RadiusTruth(query_xy=xy[5:6], database_xy=xy).positives(4.0).of(0)  # [3, 4, 5, 6, 7]
    """

    unit: ClassVar[Unit] = "m"
    query_xy: Num[np.ndarray, "queries 2"]
    database_xy: Num[np.ndarray, "database 2"]

    def __post_init__(self) -> None:
        for side in ("query_xy", "database_xy"):
            object.__setattr__(self, side, require_positions(side, getattr(self, side)))

    def positives(self, threshold: float) -> Positives:
        return positives_within(self.query_xy, self.database_xy, threshold)

    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        return np.linalg.norm(self.database_xy - self.query_xy[query], axis=1)


@dataclass(frozen=True)
class LabelTruth(Truth):
    """Labels of floors or rooms as numbers; database images with the query's label are correct. -1 = no label.

    Example:
        truth = mfvpr.datasets.LabelTruth(query_labels=np.array([1, -1]), database_labels=np.array([0, 1, 1]))
        truth.positives().of(0)  # [1, 2]
    """

    unit: ClassVar[Unit] = "exact"
    query_labels: Int[np.ndarray, " queries"]
    database_labels: Int[np.ndarray, " database"]

    def positives(self, threshold: float = 0) -> Positives:
        rows = (np.flatnonzero(self.distance(query) == 0) for query in range(len(self.query_labels)))
        return Positives.from_rows(rows, len(self.database_labels))

    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        label = self.query_labels[query]
        return np.where((self.database_labels == label) & (label >= 0), 0.0, np.inf)


@dataclass(frozen=True)
class AllowedTruth(Truth):
    """Ground `truth` without the database images that are `excluded` from the candidates of each query.

    Example:
        mfvpr.datasets.AllowedTruth(data.truth, excluded=data.truth.positives(0)).positives(1).of(0)  # [1]
    """

    truth: Truth
    excluded: Positives

    @property
    def unit(self) -> Unit:
        return self.truth.unit

    def positives(self, threshold: float) -> Positives:
        return self.truth.positives(threshold) - self.excluded

    def shows_place(self, threshold: float) -> Positives:
        return self.truth.shows_place(threshold) | self.excluded

    def distance(self, query: int) -> Float[np.ndarray, " database"]:
        distance = np.array(self.truth.distance(query), np.float64)
        distance[self.excluded.of(query)] = np.inf
        return distance


def truth_from_names(query_names: Sequence[str], database_names: Sequence[str]) -> RadiusTruth:
    """UTM positions from names `@easting@northing@...` (the convention of VPR-datasets-downloader)."""
    sides = []
    for names in (query_names, database_names):
        positions = []
        for name in names:
            try:  # folders may contain '@' as well
                easting, northing = map(parse_number, PurePosixPath(name).name.split("@")[1:3])
            except ValueError:
                mend = "or choose another ground truth"
                raise InputError(f"{name}: expected a name like @easting@northing@..., in meters; {mend}") from None
            positions.append((easting, northing))
        sides.append(require_positions("positions in names", positions, len(names)))
    return RadiusTruth(*sides)


def likely_ground_truth(query_names: Sequence[str], database_names: Sequence[str]) -> tuple[str, str] | None:
    """`utm` or `order`, and why names suggest it; None = they suggest nothing."""
    try:
        truth_from_names(query_names, database_names)
        return "utm", "names have positions"
    except InputError:
        pass
    if query_names == database_names:
        return "order", "query i shows database image i, of the same name"
    if len(query_names) == len(database_names):
        return "order", f"query i shows database image i, if both folders are one path of {len(query_names)} images"
    return None


def truth_from_labels(
    query_file: Path | str, database_file: Path | str, query_names: Sequence[str], database_names: Sequence[str]
) -> LabelTruth:
    """Ground truth by equal labels, from a csv with the columns `name,label` for each side, one line per image.

    Labels are compared as text, without spaces around them. No image is correct for or with an empty label.
    """
    sides = []
    for path, names in ((Path(query_file), query_names), (Path(database_file), database_names)):
        with _reading(path):
            lines = _csv_columns(path, choices=(("name", "label"),))
        table, labels = _row_table(names), dict[int, str]()
        for number, (name, label) in enumerate(lines, start=1):
            row = table.get(name.strip())
            if row is None or row in labels:
                expected = "the path of one image, each once"
                raise InputError(f"{path}: entry {number}: expected {expected}, got {shorten(name)!r}")
            labels[row] = label.strip()
        sides.append(require_all(path, names, [labels.get(row) for row in range(len(names))], _LINES))
    numbers = {"": -1} | {label: number for number, label in enumerate(sorted({*sides[0], *sides[1]} - {""}))}
    return LabelTruth(*(np.array([numbers[label] for label in side], np.int32) for side in sides))


def truth_from_file(
    path: Path | str, query_names: Sequence[str], database_names: Sequence[str], *, widened: bool = False
) -> Truth:
    """Ground truth from an index file.

    * `.csv`: a header with the columns `query` and `database` (or SSM-VPR's `Live` and `Reference`), then one line per
      pair: file names, or numbers from 0 in file order. An empty database cell means that the place is unknown.
    * `.npz`: arrays `query` and `database`, the same pairs; or Patch-NetVLAD's `utmQ` and `utmDb`.
    * `.json`: VPR-Bench's `[[query, [database, ...]], ...]`.

    If `widened`, database images within a tolerance in frames count as well, for databases that are sequences.
    """
    path = Path(path)
    with _reading(path):
        if path.suffix.lower() == ".csv":
            content = _csv_columns(path, choices=(("query", "database"), ("live", "reference")))
        elif path.suffix.lower() == ".json":
            content = json.loads(path.read_text(encoding="utf-8"))
            if not all(isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list) for entry in content):
                raise InputError("expected [[query, [database, ...]], ...] as in VPR-Bench, got others; convert it")
            content = [(query, place) for query, places in content for place in (places or [""])]
        elif path.suffix.lower() == ".npz":
            arrays = read_npz(path, ("utmQ", "utmDb", "query", "database"))
            if {"utmQ", "utmDb"} <= arrays.keys():
                sides = ("utmQ", query_names), ("utmDb", database_names)
                return RadiusTruth(*(require_positions(name, arrays[name], len(names)) for name, names in sides))
            if not {"query", "database"} <= arrays.keys():
                raise InputError("expected arrays query and database, or utmQ and utmDb, got neither; rename them")
            content = list(zip(arrays["query"].tolist(), arrays["database"].tolist(), strict=True))
        else:
            raise InputError(f"expected a file named .csv, .npz, .json, got {path.suffix or 'no suffix'}; convert it")
    sides = ("query", query_names, _row_table(query_names)), ("database", database_names, _row_table(database_names))
    rows: dict[int, list[int]] = {}
    for line, pair in enumerate(content, start=1):
        places: list[int] = []
        for (side, names, table), value in zip(sides, pair, strict=True):
            text = str(value).strip()
            text = text.lstrip("0") or "0" if text.isdecimal() else text
            if side == "database" and not text:
                continue
            if text not in table:
                expected = f"the name of a {side} image or a number from 0 to {len(names) - 1}"
                raise InputError(f"{path}: pair {line}: expected {expected}, got {shorten(text)!r}")
            places.append(table[text])
        rows.setdefault(places[0], []).extend(places[1:])
    places_by_query = require_all(path, query_names, [rows.get(row) for row in range(len(query_names))], _LINES)
    return FrameTruth(tuple(map(tuple, places_by_query)), len(database_names), widened)


def _csv_columns(path: Path, choices: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Cells of the first of several pairs of columns that a csv has."""
    with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:  # as file names are decoded
        lines = csv.reader(file)
        names = [name.strip().lower() for name in next(lines, [])]
        for pair in choices:
            if all(names.count(column) == 1 for column in pair):
                first, second = map(names.index, pair)
                padding = [""] * len(names)  # missing cells at the end of a line are empty
                return [((line + padding)[first], (line + padding)[second]) for line in lines if line]
    got = shorten(",".join(names)) or "no header"
    raise InputError(f"{path}: expected a header with the columns {','.join(choices[0])}; got {got}")


def _row_table(names: Sequence[str]) -> dict[str, int]:
    """Rows by number, by unique file names, and by relative path, which counts first."""
    bases = [PurePosixPath(name).name for name in names]
    counts = Counter(bases)
    table = {str(row): row for row in range(len(names))}
    table |= {base: row for row, base in enumerate(bases) if counts[base] == 1}
    return table | {name: row for row, name in enumerate(names)}
