"""Ground truth from files: pairs of images, positions, or labels. No code in the files is executed."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mfvpr.datasets.ground_truth import FrameTruth, LabelTruth, RadiusTruth, Truth, require_positions
from mfvpr.io.containers import choose_reader, reading, shorten
from mfvpr.io.names import require_all
from mfvpr.io.npz import read_npz
from mfvpr.utils.errors import InputError

MAX_DIGITS = 20  # of a row number
_LINES = "lines (with an empty cell if it has no place or label)"
_reading = partial(reading, kind="a ground truth file", mend="see mfvpr/datasets/README.md")


def truth_from_labels(
    query_file: Path | str, database_file: Path | str, query_names: Sequence[str], database_names: Sequence[str]
) -> LabelTruth:
    """Ground truth by equal labels, from a csv with the columns `name,label` for each side, one line per image.

    A query with an empty label has no correct database image, and a database image with an empty label is never
    correct. Labels are compared as text, without spaces around them.
    """
    labels = [_labels(Path(query_file), query_names), _labels(Path(database_file), database_names)]
    numbers = {"": -1} | {label: number for number, label in enumerate(sorted({*labels[0], *labels[1]} - {""}))}
    return LabelTruth(*(np.array([numbers[label] for label in side], np.int32) for side in labels))


def truth_from_file(
    path: Path | str, query_names: Sequence[str], database_names: Sequence[str], *, widened: bool = False
) -> Truth:
    """Ground truth from an index file.

    * `.csv`: a header with the columns `query` and `database` (or SSM-VPR's `Live` and `Reference`), then one line per
      pair: file names, or numbers from 0 in file order. A query may have several lines; an empty database cell means
      that its place is not in the database.
    * `.npz`: arrays `query` and `database`, the same pairs; or Patch-NetVLAD's `utmQ` and `utmDb`.
    * `.json`: VPR-Bench's `[[query, [database, ...]], ...]`.

    If `widened`, database images within a tolerance in frames count as well, for databases that are sequences.
    """
    path = Path(path)
    csv_pairs = partial(_csv_columns, choices=(("query", "database"), ("live", "reference")))
    readers: dict[str, Callable[[Path], Any]] = {".csv": csv_pairs, ".npz": _npz_pairs, ".json": _json_pairs}
    with _reading(path):
        content = choose_reader(path, readers)(path)
    if not isinstance(content, dict):
        return _frame_truth(path, content, query_names, database_names, widened)
    for (name, xy), images in zip(content.items(), (query_names, database_names), strict=True):
        require_positions(f"{path}: {name}", xy, len(images))
    return RadiusTruth(*content.values())


def _frame_truth(
    path: Path, pairs: Iterable[tuple[Any, Any]], queries: Sequence[str], database: Sequence[str], widened: bool
) -> Truth:
    query_rows, database_rows = _row_table(queries), _row_table(database)
    rows: dict[int, list[int]] = {}
    for line, (query, place) in enumerate(pairs, start=1):
        row = _row(path, line, "query", query, query_rows, len(queries))
        places = rows.setdefault(row, [])
        if str(place).strip():
            places.append(_row(path, line, "database", place, database_rows, len(database)))
    places_by_query = require_all(path, queries, [rows.get(row) for row in range(len(queries))], _LINES)
    return FrameTruth(tuple(map(tuple, places_by_query)), len(database), widened)


def _labels(path: Path, names: Sequence[str]) -> list[str]:
    table = _row_table(names)
    labels: dict[int, str] = {}
    with _reading(path):
        lines = _csv_columns(path, choices=(("name", "label"),))
    for number, (name, label) in enumerate(lines, start=1):
        row = table.get(name.strip())
        if row is None:
            several = any(PurePosixPath(image).name == name.strip() for image in names)
            mend = "several images have this name, give their paths" if several else "no image has this name, remove it"
            raise InputError(f"{path}: entry {number}: got {shorten(name)!r}; {mend}")
        if row in labels:
            raise InputError(f"{path}: entry {number}: {shorten(name)!r} has a label already; keep one of them")
        labels[row] = label.strip()
    return require_all(path, names, [labels.get(row) for row in range(len(names))], _LINES)


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


def _npz_pairs(path: Path) -> list[tuple[Any, Any]] | dict[str, np.ndarray]:
    arrays = read_npz(path, ("utmQ", "utmDb", "query", "database"))
    if {"utmQ", "utmDb"} <= arrays.keys():
        return {name: arrays[name].astype(np.float64) for name in ("utmQ", "utmDb")}
    if {"query", "database"} <= arrays.keys():
        query, database = arrays["query"], arrays["database"]
        if query.shape != database.shape or query.ndim != 1:
            shapes = f"{query.shape} and {database.shape}"
            raise InputError(f"{path}: expected query and database of one length, got {shapes}")
        return list(zip(query.tolist(), database.tolist(), strict=True))
    raise InputError(
        f"{path}: expected arrays query and database, or utmQ and utmDb; got {shorten(', '.join(arrays)) or 'neither'}"
    )


def _json_pairs(path: Path) -> list[tuple[Any, Any]]:
    entries = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(entries, list) or not all(
        isinstance(entry, list) and len(entry) == 2 and isinstance(entry[1], list) for entry in entries
    ):
        raise InputError(f"{path}: expected [[query, [database, ...]], ...] as in VPR-Bench")
    return [(query, place) for query, places in entries for place in (places or [""])]


def _row_table(names: Sequence[str]) -> dict[str, int]:
    """Rows by relative path, and by unique file names."""
    bases = [PurePosixPath(name).name for name in names]
    counts = Counter(bases)
    table = {base: row for row, base in enumerate(bases) if counts[base] == 1}
    return table | {name: row for row, name in enumerate(names)}


def _row(path: Path, line: int, side: str, value: Any, table: dict[str, int], count: int) -> int:
    text = str(value).strip()
    if text in table:
        return table[text]
    if text.isascii() and text.isdigit() and len(text) < MAX_DIGITS and int(text) < count:
        return int(text)
    raise InputError(
        f"{path}: pair {line}: expected the name of a {side} image or a number from 0 to {count - 1}, got "
        f"{shorten(text)!r}"
    )
